"""Sink that shows loops and status in the rerun viewer (extra `view`): `rerun`, `rerun:HOST:PORT`, `rerun:FILE.rrd`."""

import os
import socket
import time
from pathlib import Path
from typing import Any

import numpy as np

from sglpr_jax.files import check_writable, raising_write_error
from sglpr_jax.live.data_types import FrameStatus, LoopEdge, Report
from sglpr_jax.live.options import LiveOptions

os.environ.setdefault("RUST_LOG", "off")  # read by the import; the node has its own line for a lost viewer
import rerun
import rerun.blueprint as views

VIEWER = "127.0.0.1:9876"
"""Address at which the viewer listens if it is started without options."""
CONNECT_S = 2.0
"""Maximum time to reach the viewer at the start, in seconds."""
CHECK_S, MAX_CHECK_S = 1.0, 0.02
"""Time between two checks of the connection, and the maximum time that a check takes, in seconds."""
LOOP_COLOUR = (60, 180, 75)
"""Colour of a loop, red, green, blue."""


class RerunSink:
    """Shows each loop as text and, if both scans have odometry, as a line on the map. Plots the status of each scan.
    The viewer's time lines are `frame` and, if scans have times, `time`."""

    def __init__(self, stream: Any):
        """Take a `rerun.RecordingStream`. `close` disconnects it."""
        self._stream, self._checked_at = stream, time.monotonic()
        self._odometry_frame = 0  # `LoopEdge.odometry_frame` of the last loop
        self._stream.log("map", rerun.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)

    def frame(self, status: FrameStatus) -> None:
        """Plot the status after a scan. Raises RuntimeError if the connection to the viewer is lost."""
        self._set_time(status.frame, status.time)
        self._plot("milliseconds/scan", 1e3 * status.seconds)
        self._plot("milliseconds/latency", 1e3 * status.latency_s)
        self._plot("scans/dropped", status.dropped)
        self._plot("scans/places", status.places)
        if time.monotonic() - self._checked_at > CHECK_S:
            self._checked_at = time.monotonic()
            try:
                self._stream.flush(timeout_sec=MAX_CHECK_S)
            except RuntimeError as error:
                if "timed out" not in str(error):  # a slow viewer is not a lost one
                    raise

    def loop(self, edge: LoopEdge) -> None:
        """Write a loop as text, and draw a line between the positions of its scans. The first loop in a new odometry
        frame deletes the lines in the earlier one."""
        self._set_time(edge.query, edge.query_time)
        text = f"query {edge.query}, match {edge.match}: probability {edge.probability:.4f}"
        self._stream.log("loops", rerun.TextLog(text))
        self._plot("probability/loop", edge.probability)
        if edge.odometry_frame != self._odometry_frame:
            self._odometry_frame = edge.odometry_frame
            self._stream.log("map/loops", rerun.Clear(recursive=True))
        if edge.world_from_query is not None and edge.world_from_match is not None:
            ends = np.stack([edge.world_from_match[:3, 3], edge.world_from_query[:3, 3]])
            self._stream.log(f"map/loops/{edge.query}", rerun.LineStrips3D([ends], colors=[LOOP_COLOUR], labels=[text]))

    def close(self) -> None:
        """Disconnect from the viewer, or finish the file."""
        self._stream.disconnect()

    def _set_time(self, frame: int, seconds: float) -> None:
        """Set the frame and, if it is known, the time of what is logged next."""
        self._stream.reset_time()
        self._stream.set_time("frame", sequence=frame)
        if np.isfinite(seconds) and seconds > 0:
            self._stream.set_time("time", timestamp=seconds)

    def _plot(self, name: str, value: float | int) -> None:
        self._stream.log(name, rerun.Scalars(value))


def open_sink(where: str, options: LiveOptions, report: Report) -> RerunSink:
    """Connect to a viewer at the address `where`, or begin the file `where` (.rrd). An existing file is replaced.

    If no viewer listens, a report says so, and the returned sink draws nothing.

    Raises:
      ValueError: If `where` is neither an address nor a file that ends with .rrd.
      IsADirectoryError: If the file is a folder.
      WriteError: If the file cannot be written.
    """
    if where.endswith(".rrd"):
        check_writable(Path(where))
        with raising_write_error(Path(where)):
            Path(where).parent.mkdir(parents=True, exist_ok=True)
        stream = rerun.RecordingStream("sglpr-jax")
        stream.save(where, default_blueprint=_layout())
        return RerunSink(stream)
    host, _, port = (where or VIEWER).rpartition(":")
    if not host or not port.isdecimal() or not 0 < int(port) < 65536:
        raise ValueError(f"rerun:{where}: expected rerun, rerun:HOST:PORT or rerun:FILE.rrd, found {where}")
    try:
        socket.create_connection((host, int(port)), timeout=CONNECT_S).close()
    except OSError as error:
        expected = f"rerun: expected a viewer at {host}:{port}"
        report("rerun", f"{expected}, found none ({error}); start `rerun` before bin/live")
        return RerunSink(rerun.RecordingStream("sglpr-jax", default_enabled=False))
    stream = rerun.RecordingStream("sglpr-jax")
    stream.connect_grpc(f"rerun+http://{host}:{port}/proxy", default_blueprint=_layout())
    return RerunSink(stream)


def _layout() -> Any:
    """Return the layout of the viewer: the map, three plots, and the loops as text."""
    names = "milliseconds", "scans", "probability"
    plots = [views.TimeSeriesView(origin=name, name=name.capitalize()) for name in names]
    plots_and_loops = views.Vertical(*plots, views.TextLogView(origin="loops", name="Loops"))
    return views.Blueprint(views.Horizontal(views.Spatial3DView(origin="map", name="Map"), plots_and_loops))
