"""bin/loops, killed, ends with the same files, to the byte, as if it had not been."""

import os
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from sglpr_jax.cli.config_file import COMMAND_FILE
from sglpr_jax.sim.dataset import simulate
from sglpr_jax.sim.sensor import Sensor

from .conftest import run_command

SENSOR = Sensor(elevations_deg=tuple(np.linspace(2, -24, 16)), azimuth_steps=120)
TIMEOUT_S = 300


def killed(arguments: tuple[object, ...], out: Path, *, at: int) -> bytes:
    """Start the command in a process, and kill it when its log has a number of bytes. Returns the log."""
    command = list(map(str, (sys.executable, "-m", "sglpr_jax.cli.loops", *arguments, "--out", out)))
    environment = {**os.environ, "JAX_PLATFORMS": "cpu"}
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, env=environment)
    log, end = out / "unfinished" / "checkpoint.log", time.monotonic() + TIMEOUT_S
    while not (log.exists() and log.stat().st_size >= at) and process.poll() is None and time.monotonic() < end:
        time.sleep(0.002)
    assert process.poll() is None
    process.kill()
    process.wait()
    return log.read_bytes()


def results(arguments: tuple[object, ...], out: Path) -> dict[str, bytes]:
    """Files of a complete run, without the one that names `out`."""
    ended = run_command("loops", *arguments, "--out", out)
    assert ended.status == 0, ended.error
    return {path.name: path.read_bytes() for path in out.iterdir() if path.name != COMMAND_FILE}


@pytest.mark.slow
def test_a_killed_run_continues_to_the_same_files(tmp_path):
    simulate(tmp_path / "town", routes=("08",), scans=90, sensor=SENSOR)
    arguments, out = (tmp_path / "town", "--min-probability", "0.5"), tmp_path / "killed"
    first = killed(arguments, out, at=20_000)
    assert killed(arguments, out, at=len(first) + 20_000).startswith(first[:20_000])  # scans are not described again
    whole = results(arguments, tmp_path / "whole")
    assert results(arguments, out) == whole and whole["loops.jsonl"]
