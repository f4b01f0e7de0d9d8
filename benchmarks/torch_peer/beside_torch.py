"""What the comparisons with PyTorch share: what they need, and the table of every way of ours beside every one of its.

PyTorch runs eagerly and, if asked for, through `torch.compile`.
"""

import os
import shutil
from collections.abc import Callable, Sequence
from typing import Any, Literal

import numpy as np

from benchmarks.speed.ratio import (
    Contender,
    Job,
    alternate,
    check_equal,
    report,
    report_resources,
    require_torch,
    warn_if_busy,
)

Preset = Literal["circular", "sglpr", "paper"]
"""The models of which there is a PyTorch counterpart."""


def prepare_to_compare(threads: int, *, compiled: bool) -> None:
    """Raises SystemExit where PyTorch or, to compile, a C++ compiler is missing; warns on a busy machine."""
    require_torch()
    compiler = os.environ.get("CXX", "g++")  # as torch.compile looks for it
    if compiled and shutil.which(compiler) is None:
        raise SystemExit(f"--compiled: torch.compile needs a C++ compiler, but there is no {compiler}")
    warn_if_busy(threads)


def torch_contenders(make_job: Callable[..., Job], *arguments: Any, compiled: bool, threads: int) -> list[Contender]:
    """PyTorch eager and, if asked for, compiled: the last argument of the job."""
    names = {"PyTorch": False} | ({"PyTorch compiled": True} if compiled else {})
    return [Contender(name, make_job, *arguments, through, threads=threads) for name, through in names.items()]


def compare(
    title: str,
    theirs: Sequence[Contender],
    ours: Sequence[Contender],
    *,
    first: Callable[[Contender], np.ndarray],
    what: str,
    tolerance: float,
    repeats: int,
    threads: int,
    calls: int = 1,
) -> None:
    """Check that all give the same `first` results, time runs of so many calls in turn, and print the tables."""
    expected = first(theirs[0])
    for contender in (*theirs[1:], *ours):
        check_equal(f"{what}, {contender.name}", first(contender), expected, tolerance=tolerance)
    everyone = [*theirs, *ours]
    for contender in everyone:
        contender.forget_peak()
    seconds = dict(zip(everyone, (alternate(everyone, repeats=repeats) / calls).T, strict=True))
    for other in theirs:
        rows = [(one.name, seconds[one], seconds[other]) for one in ours]
        report(title, rows, other=other.name, packages=("jax", "torch", "optax"), threads=threads)
    report_resources(everyone, calls=calls)
