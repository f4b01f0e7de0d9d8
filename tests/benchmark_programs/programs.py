"""Benchmarks run as a user runs them: in this process, which has imported and compiled what they share."""

import concurrent.futures
import contextlib
import io
import os
import runpy
import sys
import warnings
from pathlib import Path
from unittest import mock

import pytest

from sglpr_jax.sim.sensor import Sensor

ROOT = Path(__file__).resolve().parents[2]
TINY = ROOT / "tests" / "tiny.py"
"""A preset of next to no arithmetic."""
SENSOR = Sensor(elevations_deg=(2.0, -2.0, -8.0, -16.0), azimuth_steps=90)


class _ThreadPool(concurrent.futures.ThreadPoolExecutor):
    """Stands in for a pool of processes: a process that starts spends seconds on imports."""

    def __init__(self, workers: int, *, mp_context: object):
        super().__init__(workers)


def printed(benchmark: str, *options: object) -> str:
    """Run `python -m benchmarks.FOLDER.NAME` and return what it prints."""
    module, out, errors = f"benchmarks.{benchmark}", io.StringIO(), io.StringIO()
    with (
        pytest.MonkeyPatch.context() as patch,
        mock.patch.dict(os.environ),  # benchmarks set variables for processes to come
        contextlib.redirect_stdout(out),
        contextlib.redirect_stderr(errors),
        warnings.catch_warnings(),
    ):
        warnings.simplefilter("default")  # only tests make errors of them
        patch.setattr(sys, "argv", [benchmark, *map(str, options)])
        patch.setattr(concurrent.futures, "ProcessPoolExecutor", _ThreadPool)
        patch.delitem(sys.modules, module, raising=False)  # runpy warns of a module that is there
        try:
            runpy.run_module(module, run_name="__main__", alter_sys=True)
        except SystemExit as end:
            assert end.code in (None, 0), errors.getvalue() or end.code
    return out.getvalue()


def table(output: str) -> list[list[str]]:
    """The rows of a printed table."""
    return [[cell.strip() for cell in line.split("│")[1:-1]] for line in output.splitlines() if "│" in line]
