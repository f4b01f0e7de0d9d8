"""The node lives on, whatever a scan, a sink or the odometry does, and hands on what the map finds."""

import json
import os

import numpy as np
import pytest

from sglpr_jax.data.scan import Scan
from sglpr_jax.files import WriteError, in_short
from sglpr_jax.live.data_types import AGAIN_S, FrameStatus, LiveFrame, LoopEdge, Reports
from sglpr_jax.live.live_map import LiveMap
from sglpr_jax.live.node import Node
from sglpr_jax.live.options import LiveOptions
from sglpr_jax.live.sources_and_sinks import open_sink

EDGE = LoopEdge(7, 2, 70.0, 20.0, np.eye(4), np.eye(6), 0.97, np.eye(4), None, 0.01)


class FakeMap(LiveMap):
    """A map whose scan 1 is invalid, and whose scan 2 is left out."""

    nbytes = 5_000_000

    class detector:
        class finder:
            stored = (1, 2, 3)

    def __init__(self, error: Exception):
        self.added, self.trajectory, self.error = [], None, error

    def __len__(self) -> int:
        return len(self.added)

    def add(self, frame):
        if frame.time == 1:
            raise self.error
        if frame.time == 2:
            return None
        self.added.append(frame)
        return [EDGE] if frame.time == 3 else []


class Frames:
    """A source of five scans with a pause."""

    dropped = 4

    def __init__(self, frame):
        self.frame = frame

    def close(self):
        pass

    def frames(self):
        for i in range(5):
            yield self.frame._replace(time=float(i))
            yield None


class Kept:
    """A sink that keeps what it gets, or loses its connection at the first loop."""

    def __init__(self, fails: bool = False):
        self.fails, self.seen = fails, []

    def close(self):
        pass

    def frame(self, status):
        self.seen.append(status)

    def loop(self, edge):
        if self.fails:
            raise RuntimeError("connection lost")
        self.seen.append(edge)


@pytest.fixture
def frame() -> LiveFrame:
    return LiveFrame(Scan(points=np.ones((3, 3), np.float32)), 0.0, None, 0.0)


@pytest.mark.parametrize("error", [ValueError, np.linalg.LinAlgError, KeyError, RuntimeError])
def test_bad_scans_and_broken_sinks_are_reported_and_left_out(frame, said, error):
    good, bad, lines = Kept(), Kept(fails=True), []
    node = Node(FakeMap(error("expected points, found none")), [bad, good], report=said, say=lines.append)
    node.run(Frames(frame))
    assert [type(one) for one in good.seen] == [FrameStatus, LoopEdge, FrameStatus, FrameStatus]
    assert [one.frame for one in good.seen if isinstance(one, FrameStatus)] == [0, 1, 2]
    assert len(bad.seen) == 1 and good.seen[0].dropped == 4 and good.seen[0].places == 3
    assert [text for _, text in said] == [
        f"a scan is left out: {in_short(error('expected points, found none'))}",
        "Kept is left out: connection lost",
    ]
    assert str(node).endswith("4 dropped, 2 left out, 1 loops; the map has 3 scans, 5 MB")


def test_equal_kinds_share_a_line():
    lines, now = [], [0.0]
    report = Reports(lines.append, clock=lambda: now[0])
    for i in range(5):
        report("a", f"a{i}")
        report("b", f"b{i}") if i == 3 else None
    now[0] = AGAIN_S
    report("a", "a5")
    assert lines == ["a0", "b3", "a5 (4 more since the last line)"]


def test_a_closed_terminal_does_not_end_the_node():
    def write(text: str) -> None:
        raise BrokenPipeError("closed")

    Reports(write)("a", "a0")


def test_results_are_lines_of_json(tmp_path, said, monkeypatch):
    with pytest.raises(WriteError, match="cannot be written"):
        open_sink(f"json:{tmp_path}", LiveOptions(), said)
    sink = open_sink(f"json:{tmp_path}/lines", LiveOptions(), said)
    sink.frame(FrameStatus(3, 1e9 + 0.123456789, 0.0123456789, 0.02, 1, 4, 100))
    sink.loop(EDGE)
    frame, loop = map(json.loads, (tmp_path / "lines").read_text().splitlines())
    assert frame["type"] == "frame" and frame["time"] == 1e9 + 0.123456789 and frame["seconds"] == 0.012346
    assert (
        loop["type"] == "loop" and loop["match_from_query"] == np.eye(4).tolist() and loop["world_from_match"] is None
    )
    content, write, free_bytes = (tmp_path / "lines").read_bytes(), os.write, [9]

    def write_to_full_disk(file: int, line: bytes) -> int:
        if not free_bytes:
            raise OSError(28, "No space left on device")
        return write(file, line[: free_bytes.pop()])

    with monkeypatch.context() as patch, pytest.raises(OSError, match="No space left"):
        patch.setattr(os, "write", write_to_full_disk)
        sink.loop(EDGE)
    sink.close()
    assert (tmp_path / "lines").read_bytes() == content
    (tmp_path / "lines").write_bytes(content + b'{"ty')  # of a program that was killed
    again = open_sink(f"json:{tmp_path}/lines", LiveOptions(), said)
    for _ in range(2):
        again.loop(EDGE)
    again.close()
    *_, unfinished, third, fourth = (tmp_path / "lines").read_text().splitlines()
    assert unfinished == '{"ty' and json.loads(third) == json.loads(fourth) == loop
