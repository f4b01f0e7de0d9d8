"""The benchmarks run for real, as a user runs them."""

import os
import subprocess
import sys
from pathlib import Path

from sglpr_jax.sim import Sensor

ROOT = Path(__file__).resolve().parents[2]
TINY = ROOT / "tests" / "tiny.py"
"""A preset of next to no arithmetic."""
SENSOR = Sensor(elevations_deg=(2.0, -2.0, -8.0, -16.0), azimuth_steps=90)


def printed(benchmark: str, *options: object) -> str:
    """What a benchmark, `FOLDER.NAME`, prints."""
    command = (sys.executable, "-m", f"benchmarks.{benchmark}", *map(str, options))
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    done = subprocess.run(command, capture_output=True, text=True, timeout=300, env=environment)
    assert done.returncode == 0, done.stderr
    return done.stdout


def table(output: str) -> list[list[str]]:
    """The rows of a printed table."""
    return [[cell.strip() for cell in line.split("│")[1:-1]] for line in output.splitlines() if "│" in line]
