"""Timing of jobs against each other on a machine that also runs other programs.

Jobs run in turn, in the opposite order at every other repeat, so that other programs slow all jobs equally. Reports
give the median and the spread of the ratios within each repeat.
"""

import importlib.metadata
import multiprocessing
import os
import platform
import resource
import shlex
import subprocess
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from benchmarks.table import Table

Job = Callable[[], Any]
SPREAD = (0.1, 0.9)  # quantiles that bound the reported spread
BUSY_ALLOWANCE = 0.5
"""Load average beyond the number of CPUs that causes no warning."""
_SPAWN = multiprocessing.get_context("spawn")


def clocked(job: Job) -> Callable[[], float]:
    """Returns a function that runs a job and returns its seconds."""

    def run() -> float:
        start = time.perf_counter()
        job()
        return time.perf_counter() - start

    return run


def in_turn(jobs: Sequence[Callable[[], float]], *, repeats: int) -> Float[np.ndarray, "repeats jobs"]:
    """Runs jobs that return their seconds, in alternating order, and returns these seconds."""
    for job in jobs:
        job()  # compiles
    seconds = np.zeros((repeats, len(jobs)))
    for repeat in range(repeats):
        for i in range(len(jobs))[:: -1 if repeat % 2 else 1]:
            seconds[repeat, i] = jobs[i]()
    return seconds


def median_seconds(job: Job, *, repeats: int) -> float:
    """Median duration of a job, in seconds."""
    return float(np.median(in_turn([clocked(job)], repeats=repeats)))


def run_command(
    command: Sequence[str | Path], environment: Mapping[str, str] = os.environ, folder: Path | str | None = None
) -> tuple[float, float]:
    """Runs a command in a folder. Returns its seconds and processor seconds. Raises SystemExit if it fails."""
    before, start = resource.getrusage(resource.RUSAGE_CHILDREN), time.perf_counter()
    ended = subprocess.run(command, capture_output=True, text=True, env=environment, cwd=folder)
    seconds, after = time.perf_counter() - start, resource.getrusage(resource.RUSAGE_CHILDREN)
    if ended.returncode:
        raise SystemExit(f"{command[:3]} failed: {ended.stderr[-2000:]}")
    return seconds, after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime


class Contender:
    """Job in a separate process. A call runs the job once and returns its seconds.

    The process calls `make_job(*arguments)`. Frameworks that this function imports use `threads` threads.
    """

    def __init__(self, name: str, make_job: Callable[..., Job], *arguments: Any, threads: int):
        self.name = name
        self._pipe, far_end = _SPAWN.Pipe()
        process = _SPAWN.Process(target=_serve, args=(far_end, threads, make_job, arguments), daemon=True)
        process.start()
        far_end.close()

    def run(self) -> tuple[Any, float]:
        """Runs the job and returns its result and its seconds. Raises SystemExit if the process has ended."""
        return self._ask("run")

    def __call__(self) -> float:
        return self.run()[1]

    def forget_peak(self) -> None:
        """Resets `usage`, so that the memory and time of compilation do not count."""
        self._ask("forget peak")

    def usage(self) -> tuple[float, float]:
        """Median processor seconds of a run over all threads, and peak of resident memory in 10^6 bytes."""
        return self._ask("usage")

    def _ask(self, question: str) -> Any:
        try:
            self._pipe.send(question)
            return self._pipe.recv()
        except (EOFError, OSError) as error:
            raise SystemExit(f"{self.name}: its process ended, for the reason above or for want of memory") from error


def _serve(pipe, threads: int, make_job: Callable[..., Job], arguments: tuple) -> None:
    """Answers the questions of a `Contender` in its process: "run", "forget peak" and "usage"."""
    os.environ["NPROC"] = os.environ["OMP_NUM_THREADS"] = str(threads)  # for XLA and for PyTorch
    job, processor_s = make_job(*arguments), []
    while True:
        try:
            question = pipe.recv()
        except EOFError:
            return
        if question == "run":
            start, processor_start = time.perf_counter(), time.process_time()
            result = job()
            pipe.send((result, time.perf_counter() - start))
            processor_s.append(time.process_time() - processor_start)
        elif question == "forget peak":
            processor_s.clear()
            pipe.send(Path("/proc/self/clear_refs").write_text("5"))  # 5 resets the peak VmHWM
        else:
            pipe.send((float(np.median(processor_s)), peak_mb()))


def peak_mb() -> float:
    """Peak of the resident memory of this process, in 10^6 bytes."""
    status = dict(line.split(":", 1) for line in Path("/proc/self/status").read_text().splitlines())
    return int(status["VmHWM"].split()[0]) * 1024 / 1e6


def resident_mb(process: int | str = "self") -> float:
    """Resident memory of a process, in 10^6 bytes."""
    return int(Path(f"/proc/{process}/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE") / 1e6


def warn_if_busy(threads: int) -> None:
    """Prints a warning if other programs leave too few CPUs for `threads`."""
    busy, cpus = os.getloadavg()[0], os.cpu_count() or 1
    if busy + threads > cpus + BUSY_ALLOWANCE:
        print(
            f"warning: other programs keep {busy:.1f} of {cpus} CPUs busy. Two threads that share a CPU cost PyTorch's "
            "OpenMP far more than JAX: take --threads 1, or wait"
        )


def check_equal(name: str, ours: np.ndarray, theirs: np.ndarray, *, tolerance: float) -> None:
    """Prints the largest difference. Raises SystemExit if it is above `tolerance` times the maximum of `theirs`."""
    difference, scale = np.abs(np.subtract(ours, theirs)).max(), np.abs(theirs).max()
    print(f"{name}: largest difference {difference:.2g}, largest value {scale:.3g}")
    if not difference <= tolerance * scale:
        raise SystemExit(f"{name}: the two do not agree, so there is nothing to time")


def report(
    title: str,
    ours: tuple[str, Float[np.ndarray, " n"]],
    other: tuple[str, Float[np.ndarray, " n"]],
    *,
    packages: Sequence[str],
    threads: int,
) -> None:
    """Prints seconds and ratios of two contenders, given as name and seconds, and the command and versions."""
    (name, seconds), (other_name, other_seconds) = ours, other
    low, middle, high = np.quantile(seconds / other_seconds, (SPREAD[0], 0.5, SPREAD[1]))
    table = Table("", f"{other_name}, ms", f"{name}, ms", f"{name} / {other_name}", "spread")
    milliseconds = (f"{1e3 * np.median(of_one):.4g}" for of_one in (other_seconds, seconds))
    table.add(title, *milliseconds, f"{middle:.3f}", f"{low:.3f} to {high:.3f}")
    print(f"Medians of {len(seconds)} repeats. Below 1 {name} is faster. Spread: the 10 % and 90 % quantiles.")
    print(f"{threads} threads each; GLIBC_TUNABLES={os.environ.get('GLIBC_TUNABLES', '')}")
    print("\n".join(about(*packages).values()))


def about(*packages: str) -> dict[str, str]:
    """Command, versions of Python and `packages`, and machine of a measurement."""
    versions = [f"{name} {importlib.metadata.version(name)}" for name in packages]
    load = ", ".join(f"{average:.1f}" for average in os.getloadavg())
    return {
        "command": shlex.join(["python", *sys.argv]),
        "versions": ", ".join([f"Python {platform.python_version()}", *versions]),
        "machine": f"{os.cpu_count()} CPUs, load average {load} at the end",
    }
