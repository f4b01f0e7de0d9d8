"""The node: scans from a topic, through the map of `bin/live`, to topics of loops."""

import contextlib
import sys
import threading
from collections.abc import Callable

import rclpy
from rclpy.executors import ExternalShutdownException

from sglpr_jax.cli.live import LiveCommand, run_node
from sglpr_jax.live.node_messages import Report, Reports
from sglpr_jax.live.ros import RosSink, RosSource, Transport
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
    """Find loops until `should_stop` is true. `connect` opens a connection: one for the source, one for the sink.

    The other arguments and the errors are those of `run_node`.
    """
    run_node(
        command,
        lambda found: RosSource(connect(), command, report),
        lambda: [RosSink(connect(), command)],
        report=report,
        say=say,
        should_stop=should_stop,
    )


def main() -> None:
    """The entry point."""
    rclpy.init()
    ros = rclpy.create_node("sglpr")
    values = {name: ros.declare_parameter(name, value).value for name, value in defaults().items()}
    log = ros.get_logger()
    report = Reports(log.warning)
    threading.Thread(target=_spin, args=(ros,), daemon=True).start()
    stop = {"say": log.info, "should_stop": lambda: not rclpy.ok()}
    try:
        run(command_of(values), lambda: RclpyTransport(ros, report), report, **stop)
    except (ValueError, OSError, ImportError) as error:
        sys.exit(f"error: {error}")
    finally:
        rclpy.try_shutdown()


def _spin(ros) -> None:
    with contextlib.suppress(ExternalShutdownException):
        rclpy.spin(ros)
