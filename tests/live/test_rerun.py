"""The rerun sink writes a file with the status and the loops, and outlives its viewer."""

import socket

import numpy as np
import pytest
from recordings import entities

from sglpr_jax.live.data_types import FrameStatus, LoopEdge
from sglpr_jax.live.options import LiveOptions
from sglpr_jax.live.rerun import RerunSink
from sglpr_jax.live.sources_and_sinks import open_sink
from sglpr_jax.se3 import transform

STATUS = FrameStatus(7, 1_700_000_000.25, 0.012, 0.02, 3, 8, 40_000)
PLACED = LoopEdge(7, 2, 70.0, 20.0, np.eye(4), np.eye(6), 0.97, transform(3.0, 4.0, 0.0), np.eye(4), 0.01)
UNPLACED = PLACED._replace(query=9, world_from_match=None)
STATUS_PLOTS = {"/milliseconds/scan", "/milliseconds/latency", "/scans/dropped", "/scans/places"}


def test_a_file_has_the_status_and_the_loops(tmp_path, said):
    path = tmp_path / "live.rrd"
    sink = open_sink(f"rerun:{path}", LiveOptions(), said)
    sink.frame(STATUS)
    sink.frame(STATUS._replace(frame=8, time=float("nan")))
    sink.loop(PLACED)
    sink.loop(UNPLACED)
    sink.loop(UNPLACED._replace(odometry_frame=1))
    sink.close()
    there = entities(path)
    assert there >= STATUS_PLOTS | {"/map/loops/7", "/map/loops", "/loops", "/probability/loop"}
    assert "/map/loops/9" not in there
    assert not said


def test_without_a_viewer_a_line_says_so_and_the_node_lives_on(said):
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    sink = open_sink(f"rerun:127.0.0.1:{port}", LiveOptions(), said)
    sink.frame(STATUS)
    sink.loop(PLACED)
    sink.close()
    assert said.kinds == ["rerun"] and f"expected a viewer at 127.0.0.1:{port}, found none" in said[0][1]


@pytest.mark.parametrize("where", ["found.txt", "host:70000"])
def test_neither_a_file_nor_an_address(where, said):
    with pytest.raises(ValueError, match=r"expected rerun, rerun:HOST:PORT or rerun:FILE.rrd"):
        open_sink(f"rerun:{where}", LiveOptions(), said)


def test_a_lost_viewer_is_an_error_and_a_slow_one_is_not(monkeypatch):
    stream = Stream("gRPC connection severed")
    monkeypatch.setattr("sglpr_jax.live.rerun.CHECK_S", -1.0)
    with pytest.raises(RuntimeError, match="severed"):
        RerunSink(stream).frame(STATUS)
    RerunSink(Stream("Flush timed out")).frame(STATUS)


class Stream:
    """A stream whose flush fails."""

    def __init__(self, error: str):
        self._error = error

    def __getattr__(self, name: str):
        return lambda *args, **options: None

    def flush(self, *, timeout_sec: float) -> None:
        raise RuntimeError(self._error)
