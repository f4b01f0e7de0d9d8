"""Commands of two checkouts in turn: whether a change made them slower."""

import os
import shlex
import shutil
import tempfile
from pathlib import Path

import numpy as np
import tyro

from benchmarks.table import Table
from benchmarks.timing import run_command

ROOT = Path(__file__).parents[2]
SIMULATE = "simulate --out towns --sensor hdl64e --azimuth-steps 900 --rate-hz 10"
LINES = (
    "loops --help",
    "embed --data one --out NEW.npz",
    "embed --data towns --seq 00 --out NEW.npz",
    "loops towns --seq 00 --out NEW",
    "loops towns --seq 00 --odometry auto --optimize --out NEW",
    "train --data towns --seq 08 --preset sglpr --steps 20 --score-every 20 --out NEW",
)
"""Commands that read a simulated drive, and one scan of it in the folder `one`. Each run writes to another NEW."""


def trees(
    other: tyro.conf.Positional[Path], *, lines: tuple[str, ...] = LINES, scans: int = 300, repeats: int = 5
) -> None:
    """Time commands of this checkout and of another one, each in a process of its own: under `taskset -c 1`.

    Each checkout runs every command once before the timed runs, which fills its caches. Both read the same scans.

    Args:
        other: the other checkout. It needs an environment in .venv, as `bin/test` makes it.
        lines: commands with their arguments.
        scans: scans of the drive.
        repeats: how often each command is timed.
    """
    checkouts = (ROOT, other.resolve())
    table = Table("command", "processor s, other", "processor s, this", "this / other", "least, most")
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        for seq in ("00", "08"):
            _processor_s(ROOT, f"{SIMULATE} --seq {seq} --scans {scans}", folder)
        (folder / "one").mkdir()
        shutil.copy(folder / "towns/sequences/00/velodyne/000000.bin", folder / "one")
        for line in lines:
            runs = [[_processor_s(checkout, line, folder) for checkout in checkouts] for _ in range(1 + repeats)]
            ours, others = np.array(runs[1:]).T
            ratios = ours / others
            seconds = (f"{np.median(values):.2f}" for values in (others, ours))
            table.add(line, *seconds, f"{np.median(ratios):.3f}", f"{ratios.min():.3f}, {ratios.max():.3f}")


def _processor_s(checkout: Path, line: str, folder: Path) -> float:
    """Processor seconds of a command of a checkout, which keeps its compiled programs in the folder."""
    new = tempfile.mkdtemp(dir=folder)
    command, *arguments = shlex.split(line.replace("NEW", f"{new}/new"))
    environment = os.environ | {"XDG_CACHE_HOME": str(folder / f"cache-{checkout.name}")}
    return run_command((checkout / "bin" / command, *arguments), environment, folder)[1]
