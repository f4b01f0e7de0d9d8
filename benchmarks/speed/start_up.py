"""Time until commands start, networks are made, weights are loaded and the first scan is described."""

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
from sglpr_jax.models.config import MODELS
from sglpr_jax.sim.recording import simulate_recording
from sglpr_jax.sim.sensor import SENSORS

ROOT = Path(__file__).resolve().parents[2]
INIT = "import jax, sglpr_jax; jax.block_until_ready(sglpr_jax.init(jax.random.key(0), preset={!r}).weights)"
LOAD = "import sglpr_jax; params = sglpr_jax.load({!r})"
DESCRIBE = f"{LOAD}; import numpy; numpy.asarray(sglpr_jax.describe(params, numpy.ones((128, 128), 'float32')))"
COMMANDS = tuple(
    sorted(path.stem for path in (ROOT / "sglpr_jax" / "cli").glob("*.py") if (ROOT / "bin" / path.stem).exists())
)


def start_up(
    *,
    commands: tuple[str, ...] = COMMANDS,
    presets: tuple[str, ...] = tuple(MODELS),
    weights: str = "sglpr",
    repeats: int = 9,
) -> None:
    """Time commands in processes of their own, one after another: under `taskset -c 1`.

    The descriptor of one scan is timed cold (nothing compiled yet, once) and warm. Processor seconds are nearer the
    truth on a machine that is busy.

    Args:
        commands: whose help is timed.
        presets: whose random weights are timed.
        weights: shipped weights that are loaded and describe.
        repeats: how often each is timed.
    """
    lines = {f"{command} --help": _command(command, "--help") for command in commands}
    programs = {f"init, {preset}": INIT.format(preset) for preset in presets}
    programs |= {"import jax": "import jax", f"load, {weights}": LOAD.format(weights)}
    lines |= {title: (sys.executable, "-c", program) for title, program in programs.items()}
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        scan = simulate_recording("08", scans=1, sensor=dataclasses.replace(SENSORS["hdl64e"], azimuth_steps=900))
        (folder / "scans").mkdir()
        points = scan.record(0).points
        np.pad(points, ((0, 0), (0, 1))).astype("<f4").tofile(folder / "scans" / "000000.bin")
        embed = _command("embed", "--data", f"{folder}/scans", "--weights", weights, "--out", f"{folder}/scans.npz")
        environment = {**os.environ, "XDG_CACHE_HOME": name}
        environment.pop("JAX_COMPILATION_CACHE_DIR", None)
        table = Table("", "seconds, least", "median", "processor seconds, least", "median")
        for title, line in (  # the second describes a batch of one, another program
            (f"load and describe one image, {weights}", (sys.executable, "-c", DESCRIBE.format(weights))),
            (f"embed one scan, {weights}", embed),
        ):
            wall, processor = run_command(line, environment)
            table.add_row(f"{title}, cold", f"{wall:.2f}", "", f"{processor:.2f}", "")
            lines[f"{title}, warm"] = line
        for title, line in lines.items():
            wall, processor = zip(*(run_command(line, environment) for _ in range(repeats)), strict=True)
            found = (min(wall), statistics.median(wall), min(processor), statistics.median(processor))
            table.add_row(title, *(f"{value:.2f}" for value in found))
    Console(width=140).print(table)
    print(f"{repeats} times each; {os.cpu_count()} CPUs, load average {os.getloadavg()[0]:.1f}")


def _command(command: str, *arguments: str) -> tuple[str, ...]:
    return sys.executable, "-m", "sglpr_jax.cli", command, *arguments
