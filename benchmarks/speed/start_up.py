"""Time until commands start, and until the first scan is described."""

import dataclasses
import os
import sys
import tempfile
from pathlib import Path

import numpy as np

from benchmarks.table import Table
from benchmarks.timing import run_command
from sglpr_jax.sim.recording import simulate_recording
from sglpr_jax.sim.sensor import SENSORS

BIN = Path(__file__).resolve().parents[2] / "bin"
COMMANDS = tuple(
    sorted(path.stem for path in (BIN.parent / "sglpr_jax" / "cli").glob("*.py") if (BIN / path.stem).exists())
)


def start_up(*, commands: tuple[str, ...] = COMMANDS, weights: str = "sglpr", repeats: int = 9) -> None:
    """Time commands in processes of their own, one after another: under `taskset -c 1`.

    The descriptor of one scan is timed cold (nothing compiled yet, once) and warm. Processor seconds are nearer the
    truth on a machine that is busy.

    Args:
        commands: whose help is timed.
        weights: shipped weights that describe the scan.
        repeats: how often each is timed.
    """
    embed = f"embed --weights {weights} --data scans --out scans.npz"
    table = Table("", "seconds, least", "median", "processor seconds, least", "median")
    with tempfile.TemporaryDirectory() as folder:
        scan = simulate_recording("08", scans=1, sensor=dataclasses.replace(SENSORS["hdl64e"], azimuth_steps=900))
        (Path(folder) / "scans").mkdir()
        np.pad(scan.points(0), ((0, 0), (0, 1))).astype("<f4").tofile(Path(folder) / "scans" / "000000.bin")
        environment = {**os.environ, "XDG_CACHE_HOME": folder, "PYTHONPATH": str(BIN.parent)}
        environment.pop("JAX_COMPILATION_CACHE_DIR", None)
        lines = [("embed one scan, cold", embed, 1), ("embed one scan, warm", embed, repeats)]
        lines += [(f"{command} --help", f"{command} --help", repeats) for command in commands]
        for title, line, times in lines:
            command = (sys.executable, "-m", "sglpr_jax.cli", *line.split())
            seconds = np.array([run_command(command, environment, folder) for _ in range(times)])
            table.add(title, *(f"{value:.2f}" for values in seconds.T for value in (values.min(), np.median(values))))
    print(f"{repeats} times each; {os.cpu_count()} CPUs, load average {os.getloadavg()[0]:.1f}")
