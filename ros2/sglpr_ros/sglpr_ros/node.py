"""The ROS 2 node: the live node of `bin/live`, with scans from a topic and loops to topics."""

import contextlib
import sys
import threading
from collections.abc import Callable

import rclpy
from rcl_interfaces.msg import ParameterDescriptor
from rclpy.executors import ExternalShutdownException
from rclpy.signals import SignalHandlerOptions

from sglpr_jax.cli.live import LiveCommand, run_node
from sglpr_jax.live.data_types import Report, Reports
from sglpr_jax.live.ros_topics import RosSink, RosSource, Transport
from sglpr_jax.stop_request import stop_on_signal
from sglpr_ros.parameters import command_of, defaults
from sglpr_ros.transport import RclpyTransport


def run(
    command: LiveCommand,
    connect: Callable[[], Transport],
    report: Report,
    *,
    say: Callable[[str], object],
    should_stop: Callable[[], bool],
) -> None:
    """Find loops until `should_stop` is true. `connect` opens a connection to ROS, once for the source and once for the
    sink. The other arguments and the errors are those of `run_node`."""
    run_node(
        command,
        lambda live_map: RosSource(connect(), command, report),
        lambda: [RosSink(connect(), command)],
        report=report,
        say=say,
        should_stop=should_stop,
    )


def main() -> None:
    """Run the node until Ctrl-C, SIGTERM or the end of ROS, and write the results. Entry point of `ros2 run`."""
    rclpy.init(signal_handler_options=SignalHandlerOptions.NO)  # ROS would end before the results are written
    node = rclpy.create_node("sglpr")
    any_type = ParameterDescriptor(dynamic_typing=True)  # a height is "auto" or a number, and 1 is a drift as 1.0 is
    values = {name: node.declare_parameter(name, value, any_type).value for name, value in defaults().items()}
    log = node.get_logger()
    report = Reports(log.warning)
    threading.Thread(target=_spin, args=(node,), daemon=True).start()
    try:
        with stop_on_signal() as stop:
            run(
                command_of(values),
                lambda: RclpyTransport(node, report),
                report,
                say=log.info,
                should_stop=lambda: stop() or not rclpy.ok(),
            )
    except (ValueError, OSError, ImportError) as error:
        sys.exit(f"error: {error}")
    finally:
        rclpy.try_shutdown()


def _spin(node) -> None:
    """Serve the callbacks of the node until ROS shuts down."""
    with contextlib.suppress(ExternalShutdownException):
        rclpy.spin(node)
