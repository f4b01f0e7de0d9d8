"""bin/loops and bin/map, killed again and again, end with the same files, to the byte, as if they had not been."""

import os
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from sglpr_jax.cli.config_file import COMMAND_FILE
from sglpr_jax.data.readers import open_recording
from sglpr_jax.pose_graph.files import write_tum
from sglpr_jax.sim.dataset import write_dataset
from sglpr_jax.sim.sensor import Sensor

pytestmark = pytest.mark.slow
SCANS = 130
SENSOR = Sensor(elevations_deg=tuple(np.linspace(2, -24, 16)), azimuth_steps=120)
TIMEOUT_S = 300


@pytest.fixture(scope="module")
def arguments(tmp_path_factory) -> tuple[object, ...]:
    """Those of a run over a simulated drive."""
    folder = tmp_path_factory.mktemp("drive")
    write_dataset(folder / "town", names=("08",), scans=SCANS, sensor=SENSOR)
    return (folder / "town", "--min-probability", "0.5")


def start(name: str, arguments: tuple[object, ...], out: Path) -> subprocess.Popen:
    command = [sys.executable, "-m", f"sglpr_jax.cli.{name}", *arguments, "--out", out]
    environment = {**os.environ, "JAX_PLATFORMS": "cpu"}
    with (out.parent / "errors.txt").open("w") as errors:
        return subprocess.Popen(list(map(str, command)), stdout=subprocess.DEVNULL, stderr=errors, env=environment)


def finish(arguments: tuple[object, ...], out: Path) -> dict[str, bytes]:
    assert start("loops", arguments, out).wait(TIMEOUT_S) == 0, (out.parent / "errors.txt").read_text()
    return {path.name: path.read_bytes() for path in out.iterdir() if path.name != COMMAND_FILE}  # it names `out`


def wait_for(process: subprocess.Popen, path: Path) -> None:
    end = time.monotonic() + TIMEOUT_S
    while not path.exists() and process.poll() is None and time.monotonic() < end:
        time.sleep(0.002)
    assert process.poll() is None


def test_a_run_killed_again_and_again_ends_like_one_that_was_not(arguments, tmp_path):
    whole, out = finish(arguments, tmp_path / "whole"), tmp_path / "killed"
    rng = np.random.default_rng(0)
    written = set()
    for name in ("000000.safetensors", "000050.safetensors"):
        process = start("loops", arguments, out)
        wait_for(process, out / "unfinished" / name)
        time.sleep(rng.uniform(0, 0.3))
        process.kill()
        process.wait()
        written.add((out / "unfinished" / "000000.safetensors").stat().st_mtime_ns)
    assert len(written) == 1  # what was seen is not seen again
    found = finish(arguments, out)
    assert found == whole
    assert len(whole["loops.jsonl"].splitlines()) > 3


def test_a_map_killed_again_and_again_ends_like_one_that_was_not(arguments, tmp_path):
    positions = open_recording(arguments[0], "08").positions
    poses = np.tile(np.eye(4), (SCANS, 1, 1))
    poses[:, :3, 3] = positions
    write_tum(tmp_path / "poses.tum", poses, np.arange(float(SCANS)))
    given = (arguments[0], "--poses", tmp_path / "poses.tum", "--spacing-m", "0")
    whole, out = tmp_path / "whole.safetensors", tmp_path / "killed.safetensors"
    for name in ("000000.safetensors", "000050.safetensors"):
        process = start("map", given, out)
        wait_for(process, tmp_path / "killed.unfinished" / name)
        process.kill()
        process.wait()
        assert not out.exists()
    for path in (whole, out):
        assert start("map", given, path).wait(TIMEOUT_S) == 0, (tmp_path / "errors.txt").read_text()
    assert out.read_bytes() == whole.read_bytes()
    left = {path.name for path in tmp_path.iterdir()}
    assert left == {"whole.safetensors", "killed.safetensors", "poses.tum", "errors.txt"}
