"""bin/live: find loop closures while the robot drives."""

import contextlib
import dataclasses
import sys
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from sglpr_jax.cli.config_file import record_command
from sglpr_jax.cli.recording import CloudOptions, DetectorFlags, report_bad_scan
from sglpr_jax.cli.runtime import print_error
from sglpr_jax.files import exclusive_lock
from sglpr_jax.live.options import LiveOptions
from sglpr_jax.models.shipped import DEFAULT_WEIGHTS
from sglpr_jax.stop_request import stop_on_signal

if TYPE_CHECKING:
    from sglpr_jax.live.data_types import Report
    from sglpr_jax.live.live_map import LiveMap
    from sglpr_jax.live.sources_and_sinks import Sink, Source


@dataclasses.dataclass(frozen=True)
class LiveCommand(LiveOptions):
    """Find loop closures while the robot drives, and publish them at once.

    Sources: `folder:PATH` (a folder into which scans are written), `bag:PATH` (a bag at its own pace), `dds` or
    `dds:DOMAIN` (ROS 2), `zenoh` or `zenoh:ENDPOINT`. Sinks: `json` (lines on standard output), `json:FILE`, `dds`,
    `zenoh`, `rerun`.

    The output folder holds the map. A command with the same --out continues it, also after a crash. Ctrl-C or SIGTERM
    ends the command and writes loops.g2o, loops.csv, rejected.jsonl, trajectory.tum and trajectory-optimized.tum. With
    --cloud or --grid, scans are also stored while the robot drives, in the folder `cloud-scans`.

    Example:
      bin/live dds --topic /points --odometry-topic /odom --sinks dds json:loops.txt --out map
      bin/live folder:incoming --poses incoming/poses.tum --out map
      bin/live bag:drive.mcap --odometry-topic /odom --rate 2 --out map --cloud map/cloud.ply --grid map/grid.yaml
    """

    source: Annotated[str, tyro.conf.Positional]
    """Source of the scans."""
    out: Path
    """Folder of the map and the results."""
    sinks: tuple[str, ...] = ("json",)
    """Receivers of loops and of the status after each scan. `dds` and `zenoh` publish /sglpr/loops, /sglpr/loop_markers
    and, with the extra gtsam, map to odom on /tf (docs/guides/live-ros.md)."""
    weights: str = DEFAULT_WEIGHTS
    """Name of shipped weights, folder of a training run, or folder with config.json and model.safetensors."""
    output: tyro.conf.OmitArgPrefixes[CloudOptions] = CloudOptions()
    decision: tyro.conf.OmitArgPrefixes[DetectorFlags] = DetectorFlags()

    @property
    def expects_odometry(self) -> bool:
        """Whether the user asked for odometry."""
        return self.odometry_topic is not None or self.poses is not None


def live(command: LiveCommand) -> int:
    """Run the command. Returns the exit status."""
    from sglpr_jax.live.data_types import Reports
    from sglpr_jax.live.sources_and_sinks import open_sink, open_source

    _check_endpoints(command)
    report = Reports()

    def open_source_of(live_map: "LiveMap") -> "Source":
        return open_source(command.source, command, report, map_names=live_map.names)

    def open_sinks() -> Iterator["Sink"]:
        return (open_sink(sink, command, report) for sink in command.sinks)

    with stop_on_signal() as stop:
        run_node(command, open_source_of, open_sinks, report=report, say=print_error, should_stop=stop)
    return stop.exit_status


def run_node(
    command: LiveCommand,
    open_source: Callable[["LiveMap"], "Source"],
    open_sinks: Callable[[], Iterable["Sink"]],
    *,
    report: "Report",
    say: Callable[[str], object],
    should_stop: Callable[[], bool],
) -> None:
    """Find loops until the source ends or `should_stop()` is true, and write the results.

    `open_source` opens the source, which skips the scans that the map already contains, and `open_sinks` the receivers
    of loops and status. `report` receives errors that do not end the command, `say` lines about the progress.

    Raises ValueError if a setting is invalid or the folder has a map of other settings, and WriteError if the folder
    cannot be written.
    """
    from sglpr_jax.live.cloud_scans import SCANS_FOLDER, CloudScans
    from sglpr_jax.live.node import Node
    from sglpr_jax.live.result_files import write_results

    with exclusive_lock(command.out), contextlib.ExitStack() as exit_stack:
        live_map = _open_map(command, report)
        exit_stack.callback(live_map.close)
        unpublished, cloud_scans = live_map.restore(), None
        if command.output.any:
            config = command.output.cloud_settings
            cloud_scans = CloudScans(command.out / SCANS_FOLDER, live_map, config=config, report=report)
        sinks = []
        for sink in open_sinks():
            exit_stack.callback(_close_sink, sink, report)
            sinks.append(sink)
        source = open_source(live_map)
        exit_stack.callback(source.close)
        node = Node(live_map, sinks, report=report, say=say, cloud_scans=cloud_scans)
        node.publish(unpublished)
        say(f"ready: {command.source}, sinks {', '.join(command.sinks)}, map in {command.out}")
        try:
            node.run(source, should_stop=should_stop)
        finally:
            say(str(node))
            paths = [*write_results(live_map, command.out), record_command(command, command.out)]
            say(f"{command.out}: {', '.join(path.name for path in paths)}")
        if cloud_scans is not None:
            recording, poses = cloud_scans.recording(command.sensor_height)
            with contextlib.redirect_stdout(sys.stderr):  # standard output has the lines of the sink `json`
                command.output.write([recording], [poses], on_bad_scan=report_bad_scan)


def _check_endpoints(command: LiveCommand) -> None:
    """Raise an error before any work if an endpoint is unknown, one would be overwritten or --cloud fails."""
    from sglpr_jax.live.result_files import RESULTS
    from sglpr_jax.live.sources_and_sinks import SINKS, SOURCES, named_module

    name, where, _ = named_module(command.source, SOURCES, kind="sources")
    flags = {"--poses": command.poses, "--odometry-topic": command.odometry_topic}
    flag = "--poses" if name == "folder" else "--odometry-topic"
    if unused := [other for other, value in flags.items() if value is not None and other != flag]:
        raise ValueError(f"{command.source}: expected odometry by {flag}, found {unused[0]}")
    output_files = [(command.out / result).resolve() for result in RESULTS]
    for sink in command.sinks:
        kind, path, _ = named_module(sink, SINKS, kind="sinks")
        if kind == "json" and path and Path(path).resolve() in output_files:
            raise ValueError(f"{sink}: expected a file that this run does not overwrite, found an output file")
    if command.poses is not None and command.poses.resolve() in output_files:
        raise ValueError(
            f"{command.poses}: expected odometry that this run does not overwrite, found an output file; "
            "choose another --out"
        )
    if command.output.any:
        from sglpr_jax.pose_graph.factor_graph import gtsam_library

        if not command.expects_odometry:
            raise ValueError("--cloud and --grid need odometry: expected --odometry-topic or --poses, found neither")
        command.output.check([Path(where)] if name == "folder" else [], submap_m=0.0)
        gtsam_library()  # an error before the drive if it is missing


def _open_map(command: LiveCommand, report: "Report") -> "LiveMap":
    """Open the map in the output folder, and compile all programs before the first scan arrives."""
    from sglpr_jax.live.live_map import LiveMap
    from sglpr_jax.live.node import warm_up
    from sglpr_jax.loops.detector import LoopDetector
    from sglpr_jax.models.weights_file import load

    params, config, odometry = load(command.weights), command.decision.detector, command.expects_odometry
    options = {"sensor_height": command.sensor_height, "expects_odometry": odometry}
    live_map = LiveMap(LoopDetector(params, config=config), command.out, report=report, **options)
    warm_up(params, config, odometry=odometry)
    return live_map


def _close_sink(sink: "Sink", report: "Report") -> None:
    """Close a sink. An error is only reported, so that the other results are still written."""
    try:
        sink.close()
    except Exception as error:  # a sink may use any library
        report("close", f"{type(sink).__name__}: {error}")
