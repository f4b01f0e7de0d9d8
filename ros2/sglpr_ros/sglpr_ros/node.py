"""The node: scans from a topic, through the map of `bin/live`, to topics of loops."""

import contextlib
import sys
import threading
from collections.abc import Callable

import rclpy
from rclpy.executors import ExternalShutdownException

from sglpr_jax.cli.live import LiveCommand
from sglpr_jax.live.corrected import corrected_trajectory
from sglpr_jax.live.live_map import LiveMap
from sglpr_jax.live.node import Node
from sglpr_jax.live.report import Report, Reports
from sglpr_jax.live.results import write_results
from sglpr_jax.live.ros_sink import RosSink
from sglpr_jax.live.ros_source import RosSource
from sglpr_jax.live.ros_wire import Wire
from sglpr_jax.live.sinks import SinkOptions
from sglpr_jax.live.sources import SourceOptions
from sglpr_jax.live.warm_up import warm_up
from sglpr_jax.loops.checkpoint import alone
from sglpr_jax.loops.detector import LoopDetector
from sglpr_jax.models.weights_file import load
from sglpr_ros.parameters import command_of, defaults
from sglpr_ros.wire import RclpyWire


def run(
    command: LiveCommand,
    connect: Callable[[], Wire],
    report: Report,
    *,
    say: Callable[[str], object],
    should_stop: Callable[[], bool],
) -> None:
    """Find loops until `should_stop` is true, and write the results.

    Arguments:
      command: Settings.
      connect: Function that opens a connection: one for the source, one for the sink.
      report: Function for trouble.
      say: Function for lines about the progress.
      should_stop: Whether ROS ends.

    Raises:
      ValueError: If a setting is invalid, or the folder has a map of other settings.
      WriteError: If the folder cannot be written.
    """
    options = SourceOptions(topic=command.topic, odometry_topic=command.odometry_topic, reliable=command.reliable)
    frames = SinkOptions(command.topic_prefix, command.map_frame, command.odometry_frame)
    with alone(command.out), contextlib.ExitStack() as opened:
        found = _map(command, report)
        opened.callback(found.close)
        sink = RosSink(connect(), frames)
        opened.callback(sink.close)
        missed = found.recall()
        source = RosSource(connect(), options, report)
        opened.callback(source.close)
        corrected = corrected_trajectory(found, odometry=command.expects_odometry, report=report)
        node = Node(found, [sink], report=report, say=say, corrected=corrected)
        node.publish(missed)
        say(f"ready: {source.topic}, map in {command.out}")
        try:
            node.run(source, should_stop=should_stop)
        finally:
            say(str(node))
            write_results(found, command.out, corrected=corrected)


def _map(command: LiveCommand, report: Report) -> LiveMap:
    """Open the map, with all programs compiled."""
    params, config, odometry = load(command.weights), command.detector, command.expects_odometry
    warm_up(params, config, odometry=odometry)
    detector = LoopDetector(params, config=config)
    height = command.sensor_height
    return LiveMap(detector, command.out, report=report, sensor_height=height, expects_odometry=odometry)


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
        run(command_of(values), lambda: RclpyWire(ros, report), report, **stop)
    except (ValueError, OSError, ImportError) as error:
        sys.exit(f"error: {error}")
    finally:
        rclpy.try_shutdown()


def _spin(ros) -> None:
    with contextlib.suppress(ExternalShutdownException):
        rclpy.spin(ros)
