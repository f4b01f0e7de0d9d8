"""Trains the networks of other publications on the same recordings for the same time, each on one core.

    python -m benchmarks.learned.train --data build/learned --out build/learned/runs
    python -m benchmarks.learned.train --methods bevplace++ disco    # beside others on the second core

The recordings are those of `data`. An interrupted training is continued, a finished one is left alone.
"""

import json
import os
import subprocess
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path

import tyro

from benchmarks.learned.data import HELD_OUT, TRAIN, folders
from sglpr_jax.cli.peers import RATES
from sglpr_jax.methods.names import LEARNED_NAMES
from sglpr_jax.training.learned.rate_search import RATES_FILE

ONE_CORE = {"JAX_PLATFORMS": "cpu", "XLA_FLAGS": "--xla_cpu_multi_thread_eigen=false intra_op_parallelism_threads=1"}


def main(
    *,
    data: Path = Path("build/learned"),
    out: Path = Path("build/learned/runs"),
    methods: Sequence[str] = LEARNED_NAMES,
    seeds: Sequence[int] = (0, 1),
    seconds: float = 3600.0,
    images: int = 0,
    search_seconds: float = 300.0,
    learning_rate: float | None = None,
) -> None:
    """Train every method with every seed, one after the other.

    Args:
        data: folder of the recordings.
        out: folder of the runs, METHOD-SEED.
        methods: names of the methods.
        seeds: seeds of weights, tuples and rotations.
        seconds: training time of each run.
        images: number of images after which a run stops, if its time is not over before; 0: no limit.
        search_seconds: training time of each of the three learning rates. Further seeds use the rate of the first.
        learning_rate: rate of all runs, in place of the search.
    """
    for method in methods:
        for seed in seeds:
            run, first = out / f"{method}-{seed}", out / f"{method}-{seeds[0]}"
            limits = {"seed": seed, "seconds": seconds, "images": images, "search-seconds": search_seconds}
            rate = learning_rate or (None if run == first else _best_rate(first))
            _train(method, data, run, limits | ({} if rate is None else {"learning-rate": rate}))


def _train(method: str, data: Path, run: Path, flags: Mapping[str, float]) -> None:
    """Train one method, or continue its run."""
    (held_out,) = folders(data, HELD_OUT)
    command = ["train", method, *folders(data, TRAIN), "--out", run, "--held-out", held_out, "--cache", data / "cache"]
    command += [text for name, value in flags.items() for text in (f"--{name}", value)]
    command += ["--resume"] if run.exists() else []
    print(f"{run}", file=sys.stderr, flush=True)
    program = [sys.executable, "-m", "sglpr_jax.cli.peers", *map(str, command)]
    subprocess.run(program, check=True, env={**os.environ, **ONE_CORE})


def _best_rate(run: Path) -> float:
    """Return the learning rate that the search of a run found."""
    return json.loads((run / RATES / RATES_FILE).read_text())["best"]


if __name__ == "__main__":
    tyro.cli(main)
