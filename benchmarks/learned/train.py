"""Trains the networks of other publications on the same recordings for the same time, each on one core.

    python -m benchmarks.learned.train --data build/learned --out build/learned/runs

The recordings are those of `data`. An interrupted training is continued, a finished one is left alone.
"""

import os
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

import tyro

from benchmarks.learned.data import HELD_OUT, TRAIN, folders
from sglpr_jax.methods.names import LEARNED_NAMES

ONE_CORE = {"JAX_PLATFORMS": "cpu", "XLA_FLAGS": "--xla_cpu_multi_thread_eigen=false intra_op_parallelism_threads=1"}


def main(
    *,
    data: Path = Path("build/learned"),
    out: Path = Path("build/learned/runs"),
    methods: Sequence[str] = LEARNED_NAMES,
    seeds: Sequence[int] = (0, 1),
    seconds: float = 3600.0,
    search_seconds: float = 300.0,
) -> None:
    """Train every method with every seed, one after the other.

    Args:
        data: folder of the recordings.
        out: folder of the runs, METHOD-SEED.
        methods: names of the methods.
        seeds: seeds of weights, tuples and rotations.
        seconds: training time of each run.
        search_seconds: training time of each of the three learning rates. Further seeds use the rate of the first.
    """
    (held_out,) = folders(data, HELD_OUT)
    for method in methods:
        for seed in seeds:
            run = out / f"{method}-{seed}"
            command = ["train", method, *folders(data, TRAIN), "--out", run, "--held-out", held_out]
            flags = {"seed": seed, "seconds": seconds, "search-seconds": search_seconds}
            command += [text for name, value in flags.items() for text in (f"--{name}", str(value))]
            command += ["--cache", data / "cache", *(["--resume"] if run.exists() else [])]
            print(f"{run}", file=sys.stderr, flush=True)
            program = [sys.executable, "-m", "sglpr_jax.cli.peers", *map(str, command)]
            subprocess.run(program, check=True, env={**os.environ, **ONE_CORE})


if __name__ == "__main__":
    tyro.cli(main)
