"""Timing two programs against each other on a machine that is never quiet.

Each runs in a process of its own. Jobs are sent to them in turn, in the opposite order at every other repeat, and the
ratio is formed within each repeat, so that load from outside meets both alike. Reported are the median of those ratios
and their spread.
"""

import importlib.metadata
import importlib.util
import multiprocessing
import os
import platform
import shlex
import sys
import time
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table

Job = Callable[[], Any]

_SPAWN = multiprocessing.get_context("spawn")


class Contender:
    """A job in a process of its own, which runs it once for each call of `run`.

    `make_job(*arguments)` is called in that process. A framework that it imports or uses first there gets `threads`
    threads.
    """

    def __init__(self, name: str, make_job: Callable[..., Job], *arguments: Any, threads: int):
        self.name = name
        self._pipe, far_end = _SPAWN.Pipe()
        process = _SPAWN.Process(target=_serve, args=(far_end, threads, make_job, arguments), daemon=True)
        process.start()
        far_end.close()

    def run(self) -> tuple[Any, float]:
        """What the job returns, and its seconds. Raises SystemExit where the process has ended."""
        try:
            self._pipe.send("run")
            return self._pipe.recv()
        except (EOFError, OSError) as error:
            raise SystemExit(f"{self.name}: its process ended, for the reason above or for want of memory") from error


def _serve(pipe, threads: int, make_job: Callable[..., Job], arguments: tuple) -> None:
    os.environ["NPROC"] = os.environ["OMP_NUM_THREADS"] = str(threads)  # XLA's and PyTorch's
    job = make_job(*arguments)
    while True:
        try:
            pipe.recv()
        except EOFError:
            return
        start = time.perf_counter()
        value = job()
        seconds = time.perf_counter() - start
        pipe.send((value, seconds))


def require_torch() -> None:
    """Raises SystemExit where PyTorch is not installed."""
    if importlib.util.find_spec("torch") is None:
        raise SystemExit("this benchmark compares with PyTorch, which is not installed: pip install 'sglpr-jax[torch]'")


def check_equal(name: str, ours: np.ndarray, theirs: np.ndarray, *, tolerance: float) -> None:
    """Print the largest difference; raises SystemExit where it is above `tolerance` times the largest value."""
    difference, scale = np.abs(np.subtract(ours, theirs)).max(), np.abs(theirs).max()
    print(f"{name}: largest difference {difference:.2g}, largest value {scale:.3g}")
    if not difference <= tolerance * scale:
        raise SystemExit(f"{name}: the two do not agree, so there is nothing to time")


def alternate(contenders: Sequence[Contender], *, repeats: int) -> np.ndarray:
    """Seconds of every run, (repeats, contenders); the order is reversed at every other repeat."""
    seconds = np.zeros((repeats, len(contenders)))
    for repeat in range(repeats):
        for i in range(len(contenders))[:: -1 if repeat % 2 else 1]:
            seconds[repeat, i] = contenders[i].run()[1]
    return seconds


def report(title: str, rows: Sequence[tuple[str, np.ndarray, np.ndarray]], *, packages: Sequence[str], threads: int):
    """Print a table of (name, seconds of ours, seconds of the other) and what is needed to repeat it."""
    table = Table("", "other, ms", "JAX, ms", "JAX / other", "spread", title=title)
    for name, ours, other in rows:
        ratios = ours / other
        low, high = np.quantile(ratios, (0.1, 0.9))
        milliseconds = (f"{1e3 * np.median(other):.4g}", f"{1e3 * np.median(ours):.4g}")
        table.add_row(name, *milliseconds, f"{np.median(ratios):.3f}", f"{low:.3f} to {high:.3f}")
    versions = ", ".join(f"{name} {importlib.metadata.version(name)}" for name in packages)
    tunables = os.environ.get("GLIBC_TUNABLES")
    Console().print(table)
    print(f"Medians of {len(rows[0][1])} repeats; below 1 JAX is faster; spread: from the 10 % to the 90 % quantile.")
    print(f"command: {shlex.join(['python', *sys.argv])}" + (f"   (GLIBC_TUNABLES={tunables})" if tunables else ""))
    print(f"Python {platform.python_version()}, {versions}; {threads} threads each; {os.cpu_count()} CPUs, load average", end=" ")
    print(", ".join(f"{load:.1f}" for load in os.getloadavg()))
