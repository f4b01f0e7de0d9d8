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
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table

Job = Callable[[], Any]

SPREAD = (0.1, 0.9)
BUSY_ALLOWANCE = 0.5
"""Load average beyond the CPUs that does not matter yet."""

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

    def forget_peak(self) -> None:
        """Let `peak_mb` begin anew: compiling needs memory, too."""
        self._pipe.send("forget peak")
        self._pipe.recv()

    def processor_s(self) -> float:
        """Median of the processor seconds, over all threads, of the runs since `forget_peak` or its start."""
        self._pipe.send("processor")
        return self._pipe.recv()

    def peak_mb(self) -> float:
        """The most resident memory of the process, in 10^6 bytes, since `forget_peak` or its start."""
        self._pipe.send("peak")
        return self._pipe.recv()


def _serve(pipe, threads: int, make_job: Callable[..., Job], arguments: tuple) -> None:
    os.environ["NPROC"] = os.environ["OMP_NUM_THREADS"] = str(threads)  # XLA's and PyTorch's
    job, processor_s = make_job(*arguments), []
    while True:
        try:
            asked = pipe.recv()
        except EOFError:
            return
        if asked == "run":
            start, used = time.perf_counter(), time.process_time()
            value = job()
            pipe.send((value, time.perf_counter() - start))
            processor_s.append(time.process_time() - used)
        elif asked == "forget peak":
            processor_s.clear()
            pipe.send(_forget_peak())
        else:
            pipe.send({"peak": _peak_mb, "processor": lambda: float(np.median(processor_s))}[asked]())


def _peak_mb() -> float:
    status = dict(line.split(":", 1) for line in Path("/proc/self/status").read_text().splitlines())
    return int(status["VmHWM"].split()[0]) * 1024 / 1e6


def _forget_peak() -> None:
    Path("/proc/self/clear_refs").write_text("5")  # of all that it can clear: VmHWM


def require_torch() -> None:
    """Raises SystemExit where PyTorch is not installed."""
    if importlib.util.find_spec("torch") is None:
        raise SystemExit("this benchmark compares with PyTorch, which is not installed: pip install 'sglpr-jax[torch]'")


def warn_if_busy(threads: int) -> None:
    """Print a warning where other programs leave too few CPUs for `threads`."""
    busy, cpus = os.getloadavg()[0], os.cpu_count() or 1
    if busy + threads > cpus + BUSY_ALLOWANCE:
        print(
            f"warning: other programs keep {busy:.1f} of {cpus} CPUs busy. Two threads that share a CPU cost PyTorch's "
            "OpenMP far more than JAX: take --threads 1, or wait"
        )


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


def report_resources(contenders: Sequence[Contender], *, calls: int = 1) -> None:
    """Print what each takes after its first runs: processor time of a run, or of each of its calls, and peak memory."""
    used = "; ".join(f"{one.name} {one.processor_s() / calls:.3g} s, {one.peak_mb():.0f} MB" for one in contenders)
    print(f"Processor time of a {'call' if calls > 1 else 'run'}, and peak of resident memory: {used}")


def report(
    title: str,
    rows: Sequence[tuple[str, np.ndarray, np.ndarray]],
    *,
    other: str,
    packages: Sequence[str],
    threads: int,
    ours: str = "JAX",
) -> None:
    """Print a table of (name, our seconds, the other's seconds), and what is needed to repeat it."""
    table = Table("", f"{other}, ms", f"{ours}, ms", f"{ours} / {other}", "spread", title=title)
    for name, our_seconds, their_seconds in rows:
        ratios = our_seconds / their_seconds
        low, high = np.quantile(ratios, SPREAD)
        milliseconds = (f"{1e3 * np.median(seconds):.4g}" for seconds in (their_seconds, our_seconds))
        table.add_row(name, *milliseconds, f"{np.median(ratios):.3f}", f"{low:.3f} to {high:.3f}")
    Console().print(table)
    print(f"Medians of {len(rows[0][1])} repeats. Below 1 {ours} is faster. Spread: the 10 % and 90 % quantiles.")
    print(f"Command: {shlex.join(['python', *sys.argv])}")
    versions = [f"{name} {importlib.metadata.version(name)}" for name in packages]
    print(", ".join([f"Python {platform.python_version()}", *versions, f"{threads} threads each"]))
    load = ", ".join(f"{average:.1f}" for average in os.getloadavg())
    print(f"{os.cpu_count()} CPUs, load average {load}; GLIBC_TUNABLES={os.environ.get('GLIBC_TUNABLES', '')}")
