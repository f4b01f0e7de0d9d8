"""bin/loops, killed, ends with the same files, to the byte, as if it had not been."""

import os
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from sglpr_jax.cli.config_file import COMMAND_FILE
from sglpr_jax.sim.dataset import write_dataset
from sglpr_jax.sim.sensor import Sensor

from .conftest import run_command

SENSOR = Sensor(elevations_deg=tuple(np.linspace(2, -24, 16)), azimuth_steps=120)
TIMEOUT_S = 300


def killed(arguments: tuple[object, ...], out: Path, *, at: Path) -> None:
    """Start the command in a process, and kill it when a file appears."""
    command = list(map(str, (sys.executable, "-m", "sglpr_jax.cli.loops", *arguments, "--out", out)))
    environment = {**os.environ, "JAX_PLATFORMS": "cpu"}
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, env=environment)
    end = time.monotonic() + TIMEOUT_S
    while not at.exists() and process.poll() is None and time.monotonic() < end:
        time.sleep(0.002)
    assert process.poll() is None
    process.kill()
    process.wait()


def results(arguments: tuple[object, ...], out: Path) -> dict[str, bytes]:
    """Files of a complete run, without the one that names `out`."""
    ended = run_command("loops", *arguments, "--out", out)
    assert ended.status == 0, ended.error
    return {path.name: path.read_bytes() for path in out.iterdir() if path.name != COMMAND_FILE}


@pytest.mark.slow
def test_a_killed_run_continues_to_the_same_files(tmp_path):
    write_dataset(tmp_path / "town", names=("08",), scans=90, sensor=SENSOR)
    arguments, out = (tmp_path / "town", "--min-probability", "0.5"), tmp_path / "killed"
    first = out / "unfinished" / "000000.safetensors"
    killed(arguments, out, at=first)
    written = first.stat().st_mtime_ns
    killed(arguments, out, at=out / "unfinished" / "000050.safetensors")
    assert first.stat().st_mtime_ns == written  # kept scans are not described again
    whole = results(arguments, tmp_path / "whole")
    assert results(arguments, out) == whole and whole["loops.jsonl"]
