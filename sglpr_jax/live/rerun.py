"""Loops and status for the rerun viewer (extra `view`): `rerun`, `rerun:HOST:PORT` or `rerun:FILE.rrd`."""

import os
import socket
import time
from pathlib import Path
from typing import Any

import numpy as np

from sglpr_jax.files import check_writable, writing
from sglpr_jax.live.node_messages import FrameStatus, LoopEdge, Report
from sglpr_jax.live.options import LiveOptions

os.environ.setdefault("RUST_LOG", "off")  # read by the import; the node has its own line for a lost viewer
import rerun
import rerun.blueprint as views

VIEWER = "127.0.0.1:9876"
"""Address at which the viewer listens if it is started without options."""
WAIT_S = 2.0
"""Maximum time to reach the viewer at the start, in seconds."""
CHECK_S, CHECK_WAIT_S = 1.0, 0.02
"""Time between two checks of the connection, and the maximum time that a check takes, in seconds."""
LINE = (60, 180, 75)
"""Colour of a loop, red, green, blue."""


class RerunSink:
    """Draws loops and plots the status. See `sources_and_sinks.Sink`.

    A loop with odometry of both scans is a line between their positions. Every loop is a line of text with its
    probability. The time lines are `frame` and, if scans have times, `time`.
    """

    def __init__(self, stream: Any):
        """Take a `rerun.RecordingStream`. `close` disconnects it."""
        self._stream, self._checked = stream, time.monotonic()
        self._stream.log("map", rerun.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)

    def frame(self, status: FrameStatus) -> None:
        """Plot the status after a scan. Raises RuntimeError if the connection to the viewer is lost."""
        self._set_time(status.frame, status.time)
        self._plot("milliseconds/scan", 1e3 * status.seconds)
        self._plot("milliseconds/latency", 1e3 * status.latency_s)
        self._plot("scans/dropped", status.dropped)
        self._plot("scans/places", status.places)
        if time.monotonic() - self._checked > CHECK_S:
            self._checked = time.monotonic()
            try:
                self._stream.flush(timeout_sec=CHECK_WAIT_S)
            except RuntimeError as error:
                if "timed out" not in str(error):  # a slow viewer is not a lost one
                    raise

    def loop(self, edge: LoopEdge) -> None:
        self._set_time(edge.query, edge.query_time)
        text = f"query {edge.query}, match {edge.match}: probability {edge.probability:.4f}"
        self._stream.log("loops", rerun.TextLog(text))
        self._plot("probability/loop", edge.probability)
        if edge.world_from_query is not None and edge.world_from_match is not None:
            ends = np.stack([edge.world_from_match[:3, 3], edge.world_from_query[:3, 3]])
            self._stream.log(f"map/loops/{edge.query}", rerun.LineStrips3D([ends], colors=[LINE], labels=[text]))

    def close(self) -> None:
        """Disconnect from the viewer, or finish the file."""
        self._stream.disconnect()

    def _set_time(self, frame: int, seconds: float) -> None:
        self._stream.reset_time()
        self._stream.set_time("frame", sequence=frame)
        if np.isfinite(seconds) and seconds > 0:
            self._stream.set_time("time", timestamp=seconds)

    def _plot(self, name: str, value: float | int) -> None:
        self._stream.log(name, rerun.Scalars(value))


def open_sink(where: str, options: LiveOptions, report: Report) -> RerunSink:
    """Connect to a viewer, or begin the file `where`. An existing file is replaced.

    Without a viewer, a line says so and nothing is drawn. The node starts all the same.

    Raises:
      ValueError: If `where` is neither an address nor a file that ends with .rrd.
      IsADirectoryError: If the file is a folder.
      WriteError: If the file cannot be written.
    """
    if where.endswith(".rrd"):
        check_writable(Path(where))
        with writing(Path(where)):
            Path(where).parent.mkdir(parents=True, exist_ok=True)
        stream = rerun.RecordingStream("sglpr-jax")
        stream.save(where, default_blueprint=_layout())
        return RerunSink(stream)
    host, _, port = (where or VIEWER).rpartition(":")
    if not host or not port.isdecimal() or not 0 < int(port) < 65536:
        raise ValueError(f"rerun:{where}: expected rerun, rerun:HOST:PORT or rerun:FILE.rrd, found {where}")
    try:
        socket.create_connection((host, int(port)), timeout=WAIT_S).close()
    except OSError as error:
        expected = f"rerun: expected a viewer at {host}:{port}"
        report("rerun", f"{expected}, found none ({error}); start `rerun` before bin/live")
        return RerunSink(rerun.RecordingStream("sglpr-jax", default_enabled=False))
    stream = rerun.RecordingStream("sglpr-jax")
    stream.connect_grpc(f"rerun+http://{host}:{port}/proxy", default_blueprint=_layout())
    return RerunSink(stream)


def _layout() -> Any:
    """The map, the loops as text, and three plots."""
    names = "milliseconds", "scans", "probability"
    plots = [views.TimeSeriesView(origin=name, name=name.capitalize()) for name in names]
    beside = views.Vertical(*plots, views.TextLogView(origin="loops", name="Loops"))
    return views.Blueprint(views.Horizontal(views.Spatial3DView(origin="map", name="Map"), beside))
