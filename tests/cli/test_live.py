"""bin/live on a folder that grows: killed in the middle, the next one goes on, and finds loops to the scans before."""

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from sglpr_jax.files import half_written
from sglpr_jax.pose_graph.files import read_g2o, read_loops_jsonl
from sglpr_jax.se3 import inverse, quaternions
from sglpr_jax.sim.recording import simulate_recording
from sglpr_jax.sim.sensor import Sensor

from .conftest import assert_one_line_error, run_command

SCANS, HALF = 130, 70
SENSOR = Sensor(elevations_deg=tuple(np.linspace(2, -24, 16)), azimuth_steps=180)
BEGIN = 1_700_000_000.25
TIMEOUT_S = 300


class Robot:
    """Writes scans and odometry, and runs bin/live beside it."""

    def __init__(self, folder: Path):
        self.folder, self.lines = folder, folder / "lines.txt"
        self.scans = folder / "scans"
        self.scans.mkdir()
        self.drive = simulate_recording("08", scans=SCANS, sensor=SENSOR, seed=3)

    def moves(self, first: int, end: int, world_from_lidar: np.ndarray) -> None:
        """Write the poses and scans of some frames."""
        times = BEGIN + self.drive.times
        with (self.folder / "poses.tum").open("a") as file:
            for i in range(first, end):
                pose = world_from_lidar[i]
                numbers = [times[i], *pose[:3, 3], *quaternions(pose[None])[0]]
                file.write(" ".join(f"{number:.9f}" for number in numbers) + "\n")
        for i in range(first, end):
            points = np.pad(self.drive.points(i), ((0, 0), (0, 1))).astype("<f4")
            points.tofile(self.scans / f"{times[i]:.6f}.bin")

    def starts(self) -> subprocess.Popen:
        flags = ("--poses", self.folder / "poses.tum", "--sinks", f"json:{self.lines}", "--min-probability", "0.5")
        line = (f"folder:{self.scans}", "--out", self.folder / "map", "--weights", "circular", *flags)
        command = [sys.executable, "-m", "sglpr_jax.cli.live", *map(str, line)]
        with (self.folder / "errors.txt").open("w") as errors:
            return subprocess.Popen(command, stderr=errors, env={**os.environ, "JAX_PLATFORMS": "cpu"})

    def waits(self, process: subprocess.Popen, frame: int) -> list[dict]:
        """Wait until a frame is reported. Returns all results."""
        end = time.monotonic() + TIMEOUT_S
        while time.monotonic() < end:
            assert process.poll() is None, (self.folder / "errors.txt").read_text()
            text = self.lines.read_text() if self.lines.exists() else ""
            found = [json.loads(line) for line in text.splitlines(keepends=True) if line.endswith("\n")]
            if any(one["type"] == "frame" and one["frame"] >= frame for one in found):
                return found
            time.sleep(0.05)
        raise AssertionError((self.folder / "errors.txt").read_text())


@pytest.mark.slow
def test_a_killed_node_goes_on_and_finds_loops_to_the_scans_before(tmp_path):
    robot = Robot(tmp_path)
    truth = robot.drive.poses.world_from_lidar
    process = robot.starts()
    robot.moves(0, HALF, truth)
    robot.waits(process, HALF - 1)
    process.kill()
    process.wait()
    robot.moves(HALF, SCANS, inverse(truth[HALF]) @ truth)  # the odometry begins at zero again
    process = robot.starts()
    found = robot.waits(process, SCANS - 1)
    process.send_signal(signal.SIGTERM)
    assert process.wait(TIMEOUT_S) == 0
    said = (tmp_path / "errors.txt").read_text()
    assert f"the map continues after {HALF} scans" in said and "begins in a frame of its own" in said
    assert [one["frame"] for one in found if one["type"] == "frame"] == list(range(SCANS))
    across = [one for one in found if one["type"] == "loop" and one["match"] < HALF <= one["query"]]
    assert len(across) > 3
    for one in across:
        true = inverse(truth[one["match"]]) @ truth[one["query"]]
        assert np.linalg.norm((inverse(true) @ np.array(one["match_from_query"]))[:2, 3]) < 2
    out = tmp_path / "map"
    assert len(read_loops_jsonl(out / "loops.jsonl")) == sum(one["type"] == "loop" for one in found)
    assert len(read_g2o(out / "loops.g2o").poses) == SCANS and not half_written(out)


def test_wrong_sources_and_folders_are_one_line(tmp_path):
    (tmp_path / "scans").mkdir()
    out = ("--out", tmp_path / "map", "--weights", "circular")
    ended = run_command("live", "ros:1", *out)
    assert_one_line_error(ended, "ros:1: expected one of the sources folder, bag, dds, zenoh, found ros")
    own = tmp_path / "map" / "trajectory.tum"
    ended = run_command("live", f"folder:{tmp_path / 'scans'}", *out, "--poses", own)
    assert_one_line_error(ended, "trajectory.tum: expected odometry that this run does not overwrite")
