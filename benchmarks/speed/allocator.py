"""Training steps with and without bin/train's settings of the allocator: time, CPU time, page faults, memory."""

import os
import resource
from typing import NamedTuple

import jax
import numpy as np
import tyro

from benchmarks.speed.inputs import random_batch
from benchmarks.speed.ratio import Contender, Job, alternate, report, warn_if_busy
from sglpr_jax.training.config import TrainConfig
from sglpr_jax.training.presets import load_preset
from sglpr_jax.training.state import new_state
from sglpr_jax.training.step import train_step

KEPT = "glibc.malloc.hugetlb=1:glibc.malloc.mmap_max=0:glibc.malloc.trim_threshold=68719476736:glibc.malloc.arena_max=1"
"""What bin/train says: buffers are huge pages, and what is freed is kept for the next step."""


class Used(NamedTuple):
    """What a timing cost its process."""

    cpu_seconds: float
    page_faults: int
    peak_gb: float


def main(*, preset: str = "circular", repeats: int = 10, steps: int = 2, points: int = 4096, threads: int = 2) -> None:
    """Time steps on the CPU in two processes in turn, one of each setting.

    Args:
        preset: a file of configs/ by name, or a path.
        repeats: how often both are timed against each other.
        steps: steps in one timing.
        points: points of each cloud.
        threads: threads that each may use.
    """
    warn_if_busy(threads)
    config = load_preset(preset)
    plain, kept = (_contender(name, tunables, config, steps, points, threads) for name, tunables in _SETTINGS.items())
    for contender in (plain, kept):
        contender.run()  # compiles
    before = [Used(*contender.run()[0]) for contender in (plain, kept)]
    seconds = alternate((plain, kept), repeats=repeats)
    after = [Used(*contender.run()[0]) for contender in (plain, kept)]
    made = (repeats + 1) * steps
    report(
        f"training steps of {preset}",
        [(preset, seconds[:, 1] / steps, seconds[:, 0] / steps)],
        ours="kept",
        other="as it comes",
        packages=("jax", "jaxlib"),
        threads=threads,
    )
    for name, old, new in zip(_SETTINGS, before, after, strict=True):
        cpu, faults = (new.cpu_seconds - old.cpu_seconds) / made, (new.page_faults - old.page_faults) / made
        print(f"{name}: {cpu:.3f} CPU s and {faults:,.0f} page faults a step, {new.peak_gb:.2f} GB at most")


_SETTINGS = {"as it comes": "", "kept": KEPT}


def _contender(name: str, tunables: str, config: TrainConfig, steps: int, points: int, threads: int) -> Contender:
    """glibc reads its settings when a process starts."""
    os.environ["GLIBC_TUNABLES"] = tunables
    return Contender(name, _job, config, steps, points, threads=threads)


def _job(config: TrainConfig, steps: int, points: int) -> Job:
    state, batch = new_state(config), jax.device_put(random_batch(config, points))

    def make_steps() -> tuple[float, int, float]:
        nonlocal state
        for _ in range(steps):
            state, metrics = train_step(state, batch, config=config)
        assert np.isfinite(float(metrics["loss"]))
        used = resource.getrusage(resource.RUSAGE_SELF)
        return used.ru_utime + used.ru_stime, used.ru_minflt, used.ru_maxrss / 1e6

    return make_steps


if __name__ == "__main__":
    tyro.cli(main)
