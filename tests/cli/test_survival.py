"""A run through the real command line that is killed, asked to stop or out of disk ends as one that never was."""

import json
import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from sglpr_jax.training.checkpoint import checkpoint_steps
from sglpr_jax.training.metrics_log import read_metrics

pytestmark = pytest.mark.slow
KILLS = ("at the start", "between checkpoints", "between checkpoints")
"""Moments of a run at which it is killed."""
STEPS = 60
SCORE_EVERY = 3
TIMES = {"steps_per_second", "data_wait"}
TIMEOUT_S = 240


class Runs:
    """Starts `bin/train` in processes of its own, on one run's folder."""

    def __init__(self, folder: Path, options: tuple[object, ...]):
        self.folder = folder
        self.metrics = folder / "metrics.jsonl"
        self.checkpoints = folder / "checkpoints"
        self.errors = folder.with_suffix(".err")
        self.command = [sys.executable, "-m", "sglpr_jax.cli.train", *map(str, options), "--out", str(folder)]

    def start(self, *, file_kib: int | None = None) -> subprocess.Popen:
        """Begin the run, or go on with it where it has begun; no file may grow beyond `file_kib`."""
        resume = ["--resume"] if (self.folder / "config.json").exists() else []
        limit = [] if file_kib is None else ["bash", "-c", f'ulimit -f {file_kib}; exec "$@"', "-"]
        with self.errors.open("wb") as errors:
            return subprocess.Popen([*limit, *self.command, *resume], stdout=subprocess.DEVNULL, stderr=errors)

    def finish(self, **options) -> int:
        """Start and wait; returns the exit status."""
        return self.start(**options).wait(TIMEOUT_S)

    def wait_for(self, process: subprocess.Popen, event: Callable[[], bool]) -> None:
        """Wait until `event`, looking a thousand times a second. The process may not end before."""
        until = time.monotonic() + TIMEOUT_S
        while not event():
            assert process.poll() is None, self.errors.read_text()
            assert time.monotonic() < until
            time.sleep(1e-3)

    def wait_for_lines(self, process: subprocess.Popen, lines: int) -> None:
        """Wait until a process just started has written so many lines of metrics."""
        before = self._inode()
        self.wait_for(process, lambda: self._inode() != before)  # a resumed run writes the file anew
        kept = self.metrics.read_bytes().count(b"\n")
        self.wait_for(process, lambda: self.metrics.read_bytes().count(b"\n") >= kept + lines)

    def wait_for_checkpoint(self, process: subprocess.Popen, *, steps: int) -> None:
        """Wait until there is a whole checkpoint of so many steps more."""
        wanted = self.last_step() + steps
        self.wait_for(process, lambda: self.last_step() >= wanted)

    def last_step(self) -> int:
        """The step of the newest whole checkpoint; 0 where there is none."""
        return max(checkpoint_steps(self.checkpoints), default=0)

    def measured(self) -> list[dict]:
        """The metrics without those of time."""
        return [{k: v for k, v in line.items() if k not in TIMES} for line in read_metrics(self.metrics)]

    def _inode(self) -> int | None:
        return self.metrics.stat().st_ino if self.metrics.exists() else None


@pytest.fixture(scope="module", autouse=True)
def _own_compiled(tmp_path_factory):
    """A killed process may leave a compiled program half-written; the other tests' are not to be among them."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("JAX_COMPILATION_CACHE_DIR", str(tmp_path_factory.mktemp("compiled")))
        yield


@pytest.fixture(scope="module")
def options(images, preset) -> tuple[object, ...]:
    """Lines of the log and checkpoints fall apart, so that stops come between them. A head alone starts quickly."""
    every = ("--steps", STEPS, "--log-every", 2, "--score-every", SCORE_EVERY)
    head = ("--model.head.input", "counts", "--model.head.cbam", "False", "--method", "polar-fft")
    return ("--seq", "06", "--data", images, "--preset", preset, *every, *head)


@pytest.fixture(scope="module")
def uninterrupted(options, tmp_path_factory) -> Runs:
    """The run that all others should be equal to. It leaves compiled programs in the cache."""
    runs = Runs(tmp_path_factory.mktemp("whole") / "run", options)
    assert runs.finish() == 0, runs.errors.read_text()
    return runs


def assert_equal(runs: Runs, uninterrupted: Runs) -> None:
    """Same measurements, same weights, and the same files, none half-written."""
    assert runs.measured() == uninterrupted.measured()
    weights = Path("weights", "model.safetensors")
    assert (runs.folder / weights).read_bytes() == (uninterrupted.folder / weights).read_bytes()
    for folder in (".", "checkpoints", "weights", "test"):
        found, expected = (sorted(os.listdir(r.folder / folder)) for r in (runs, uninterrupted))
        assert found == expected


def test_a_run_killed_again_and_again_ends_like_one_that_was_not(options, uninterrupted, tmp_path):
    runs = Runs(tmp_path / "run", options)
    rng = np.random.default_rng(0)
    steps = set()
    for number, kill in enumerate(KILLS):
        process = runs.start()
        if kill == "at the start":  # imports, compilation, restoring
            time.sleep(rng.uniform(0, 3))
        else:  # after it has come a little further
            runs.wait_for_checkpoint(process, steps=SCORE_EVERY * int(rng.integers(1, 3)))
            time.sleep(rng.uniform(0, 0.1))
        assert process.poll() is None
        process.kill()
        process.wait()
        steps.add(runs.last_step())
        if number == 1:  # as if these had been killed while they were written
            with runs.metrics.open("a") as file:
                file.write('{"step": 59, "lo')
            (runs.folder / ".config.json.1.tmp").write_text("{")
            (runs.folder / ".weights.1.tmp" / "new").mkdir(parents=True)
            (runs.checkpoints / ".59.1.tmp" / "state").mkdir(parents=True)
    assert len(steps) >= 2
    assert runs.finish() == 0, runs.errors.read_text()
    assert_equal(runs, uninterrupted)
    starts = json.loads((runs.folder / "environment.json").read_text())
    assert 2 <= len(starts["resumes"]) <= len(KILLS)


def test_signals_and_a_full_disk_stop_a_run_that_then_goes_on(options, uninterrupted, tmp_path):
    runs = Runs(tmp_path / "run", options)
    for number, status in ((signal.SIGTERM, 0), (signal.SIGINT, 130)):
        process = runs.start()
        runs.wait_for_lines(process, 3)
        process.send_signal(number)
        assert process.wait(TIMEOUT_S) == status
        assert "continue with --resume" in runs.errors.read_text()
        last = runs.last_step()
        assert f"stopped at step {last} of {STEPS}" in runs.errors.read_text()

    assert runs.finish(file_kib=8) == 1
    error = runs.errors.read_text()
    assert error.splitlines()[-1].startswith(f"error: {runs.folder}"), error
    assert re.search("File too large|Failed to write", error) and "Traceback" not in error
    assert runs.last_step() == last

    assert runs.finish() == 0, runs.errors.read_text()
    assert_equal(runs, uninterrupted)
