"""bin/live on a growing folder: after a stop, the same command continues the map and finds loops to earlier scans."""

import json
import os
import shutil
import signal
import sys
import threading
import time

import numpy as np
import pytest

from sglpr_jax import read_odometry, read_scan
from sglpr_jax.data.readers import open_recording
from sglpr_jax.extras import install_command
from sglpr_jax.files import half_written
from sglpr_jax.pose_graph.files import read_g2o, read_loops_jsonl, write_tum

from .conftest import SCANS, run_command

HALF, BEGIN, TIMEOUT_S = SCANS // 2, 1_700_000_000.25, 120


@pytest.mark.slow
def test_a_stopped_node_continues_its_map(town, tmp_path):
    recording, scans, lines = open_recording(town, "08"), tmp_path / "scans", tmp_path / "lines.txt"
    times = BEGIN + recording.times
    write_tum(tmp_path / "poses.tum", read_odometry(town / "sequences/08/poses.txt", format="kitti"), times)
    scans.mkdir()
    flags = ("--poses", tmp_path / "poses.tum", "--sinks", f"json:{lines}", "--min-probability", "0.01")
    command = ("live", f"folder:{scans}", "--out", tmp_path / "map", "--weights", "sglpr-small", *flags)
    outputs = ("--cloud", tmp_path / "map" / "cloud.ply", "--grid", tmp_path / "map" / "grid.yaml")

    def found() -> list[dict]:
        text = lines.read_text() if lines.exists() else ""
        return [json.loads(line) for line in text.splitlines(keepends=True) if line.endswith("\n")]

    def stop_after(frame: int) -> None:
        end = time.monotonic() + TIMEOUT_S
        while time.monotonic() < end and not any(one["type"] == "frame" and one["frame"] >= frame for one in found()):
            time.sleep(0.05)
        os.kill(os.getpid(), signal.SIGTERM)

    for first, last in ((0, HALF), (HALF, SCANS)):
        for row in range(first, last):
            source = town / "sequences" / "08" / "velodyne" / f"{row:06d}.bin"
            shutil.copy(source, scans / f"{times[row]:.6f}.bin")
        stopping = threading.Thread(target=stop_after, args=(last - 1,))
        stopping.start()
        ended = run_command(*command, *outputs)
        stopping.join()
        assert ended.status == 0, ended.error
        os.truncate(tmp_path / "map" / "cloud-scans" / "000001.npy", 50)  # as after a loss of power
    assert "skipped 000001: " in ended.error
    assert f"the map continues after {HALF} scans" in ended.error
    assert [one["frame"] for one in found() if one["type"] == "frame"] == list(range(SCANS))
    out = tmp_path / "map"
    assert len(read_loops_jsonl(out / "loops.jsonl")) == sum(one["type"] == "loop" for one in found())
    assert len(read_g2o(out / "loops.g2o").poses) == SCANS and not half_written(out)
    assert [int(path.stem) for path in sorted((out / "cloud-scans").iterdir())] == list(range(SCANS))
    cloud = read_scan(out / "cloud.ply")
    expected = recording.positions - recording.positions[0]
    assert len(cloud) > 1000 and np.linalg.norm(np.ptp(cloud, axis=0)) > np.linalg.norm(np.ptp(expected, axis=0))
    assert (out / "grid.pgm").exists()


def test_a_missing_package_is_told_before_anything_is_loaded(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "rerun", None)
    monkeypatch.delitem(sys.modules, "sglpr_jax.live.rerun", raising=False)
    monkeypatch.setattr("sglpr_jax.models.weights_file.load", lambda *_: pytest.fail("weights were loaded"))
    ended = run_command("live", f"folder:{tmp_path}", "--sinks", "rerun", "--out", tmp_path / "map")
    assert ended.status == 1 and install_command("view") in ended.error
    assert not (tmp_path / "map").exists()
