"""Measurements, datasets and trainings on a GPU, in three commands of some minutes each; docs/guides/gpu.md.

    python -m benchmarks.gpu simulate --out towns
    python -m benchmarks.gpu train --data towns --preset sglpr --out runs/sglpr
    python -m benchmarks.gpu measure

Each stops by itself after --minutes. The same command continues where it stopped. It runs from a checkout that is not
installed, without tyro.
"""

import argparse
import math
import sys
import time
from pathlib import Path

ROUTES = ("00", "02", "05", "06", "07", "08")
PRESETS = ("sglpr-small", "sglpr", "paper-112", "paper")
TYPES = ("bfloat16", "float32")
TRAINING_SHARE = 0.85
"""Of the minutes; in the rest of them a checkpoint is written and the weights are tested."""


def main(arguments: list[str] | None = None) -> None:
    """Run a command. Bad input ends in one line on stderr and exit status 1 (2 for an unknown option)."""
    flags = parser().parse_args(arguments)
    end = time.monotonic() + 60 * flags.minutes * (TRAINING_SHARE if flags.command == "train" else 1)
    from benchmarks.gpu import commands  # brings JAX, which --help does not need

    try:
        result, finished = getattr(commands, flags.command)(flags, lambda: time.monotonic() > end)
    except (ValueError, OSError, FloatingPointError) as error:
        sys.exit(f"error: {' '.join(str(error).split())}")
    state = "finished" if finished else "stopped in time; the same command continues"
    print(f"{result}: {state}\n{commands.summary_of(flags.results)}")


def parser() -> argparse.ArgumentParser:
    """The command line."""
    whole = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    commands = whole.add_subparsers(required=True, dest="command")
    for name, (add, about) in COMMANDS.items():
        command = commands.add_parser(name, description=about, help=about)
        command.add_argument("--minutes", type=_positive, default=9.0, help="it stops by itself after these (9)")
        command.add_argument("--results", type=Path, default=Path("build/gpu"), help="folder of results (build/gpu)")
        add(command)
    return whole


def _add_simulate(command: argparse.ArgumentParser) -> None:
    add = command.add_argument
    add("--out", type=Path, required=True, help="the dataset's folder")
    add("--seq", nargs="+", default=ROUTES, help="routes of the simulator, 00 to 10")
    add("--scans", type=_count, default=1000, help="of each route (1000)")
    add("--layout", choices=("images", "varied", "scans"), default="images", help="as bin/simulate --images, --vary")
    add("--sensor", default="hdl64e", help="as of bin/simulate")
    add("--azimuth-steps", type=_count, help="firings per turn (the real sensor's)")
    add("--seed", type=int, default=0)


def _add_train(command: argparse.ArgumentParser) -> None:
    add = command.add_argument
    add("--data", type=Path, required=True, help="a dataset of several recordings")
    add("--preset", required=True, help="a file of configs/ by name, or a path")
    add("--out", type=Path, required=True, help="the run's folder")
    add("--test", default="08", help="the recording to test on, never trained on (08)")
    add("--compute", choices=TYPES, default="bfloat16")
    add("--chunk", type=int, help="images at a time, 0: all (the preset's)")
    add("--steps", type=_count, help="all steps of the run (the preset's)")
    add("--packs", type=Path, help="pack the recordings into this folder, to read them faster")


def _add_measure(command: argparse.ArgumentParser) -> None:
    add = command.add_argument
    add("--preset", nargs="+", default=PRESETS)
    add("--compute", nargs="+", choices=TYPES, default=TYPES)
    add("--batch", nargs="+", type=_count, default=(1, 12, 64), help="images described in one call (1 12 64)")
    add("--chunk", type=int, help="images of a step at a time, 0: all (the preset's)")
    add("--repeats", type=_count, default=10, help="how often everything is timed (10)")
    add("--calls", type=_count, default=3, help="steps or descriptions in one timing (3)")
    add("--size", type=_count, help="rows of the matrices of the peak (8192; on a CPU 2048)")
    add("--products", type=_count, default=20, help="of them in one timing (20)")
    add("--peak-tflops", type=_positive, default=989.0, help="nominal peak in bfloat16 (989, an H100's)")


COMMANDS = {
    "simulate": (_add_simulate, "Rates of the simulator and of images, and a dataset."),
    "train": (_add_train, "A training, and the scores of its weights so far."),
    "measure": (_add_measure, "Steps and descriptors of presets."),
}


def _positive(text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not 0 < value < math.inf:
        raise argparse.ArgumentTypeError(f"expected a number above 0, found {text}")
    return value


def _count(text: str) -> int:
    if not text.isdecimal() or int(text) < 1:
        raise argparse.ArgumentTypeError(f"expected a whole number from 1 on, found {text}")
    return int(text)


if __name__ == "__main__":
    main()
