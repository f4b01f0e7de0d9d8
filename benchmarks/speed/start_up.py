"""Time until commands start, and until the first scan is described."""

import dataclasses
import os
import statistics
import sys
import tempfile
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.table import Table

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
    lines = {f"{command} --help": _command(command, "--help") for command in commands}
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        scan = simulate_recording("08", scans=1, sensor=dataclasses.replace(SENSORS["hdl64e"], azimuth_steps=900))
        (folder / "scans").mkdir()
        np.pad(scan.points(0), ((0, 0), (0, 1))).astype("<f4").tofile(folder / "scans" / "000000.bin")
        embed = _command("embed", "--data", f"{folder}/scans", "--weights", weights, "--out", f"{folder}/scans.npz")
        environment = {**os.environ, "XDG_CACHE_HOME": name}
        environment.pop("JAX_COMPILATION_CACHE_DIR", None)
        table = Table("", "seconds, least", "median", "processor seconds, least", "median")
        wall, processor = run_command(embed, environment)
        table.add_row(f"embed one scan, {weights}, cold", f"{wall:.2f}", "", f"{processor:.2f}", "")
        for title, line in {f"embed one scan, {weights}, warm": embed, **lines}.items():
            walls, processors = zip(*(run_command(line, environment) for _ in range(repeats)), strict=True)
            found = (min(walls), statistics.median(walls), min(processors), statistics.median(processors))
            table.add_row(title, *(f"{value:.2f}" for value in found))
    Console(width=140).print(table)
    print(f"{repeats} times each; {os.cpu_count()} CPUs, load average {os.getloadavg()[0]:.1f}")


def _command(command: str, *arguments: str) -> tuple[str, ...]:
    return sys.executable, "-m", "sglpr_jax.cli", command, *arguments
