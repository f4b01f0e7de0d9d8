"""The training loop of learned methods. It stops by time or images, can be interrupted, and resumes exactly."""

import contextlib
import math
import time
from collections.abc import Callable, Iterator
from dataclasses import asdict
from pathlib import Path

import jax
import numpy as np
from jaxtyping import Array

from sglpr_jax.methods.learned.method import LearnedMethod
from sglpr_jax.methods.learned.weights_file import LAST, save_variables
from sglpr_jax.progress import Progress, no_progress
from sglpr_jax.training.learned.batches import Batches
from sglpr_jax.training.learned.inputs import Prepared
from sglpr_jax.training.learned.run_files import (
    METRICS_FILE,
    SCORES_FILE,
    Progressed,
    RunSettings,
    claimed,
    load_state,
    save_state,
)
from sglpr_jax.training.learned.score import ScoreFn
from sglpr_jax.training.learned.step import Batch, State, new_state, train_step
from sglpr_jax.training.metrics_log import MetricsLog

FIRST_SNAPSHOT = 1000
"""Number of images at the first snapshot. Each further one has twice as many."""
START_PLACES = 100
"""Number of random places from which `LearnedMethod.start` sets weights."""
LOG_EVERY = 10
"""Number of steps between two lines of the metrics."""
SAVE_EVERY_S, REPORT_EVERY_S = 60.0, 30.0
"""Training time between two saved states, and between two lines of progress, in seconds."""


def train_learned(
    method: LearnedMethod,
    data: Prepared,
    settings: RunSettings,
    out: Path,
    *,
    score: ScoreFn | None = None,
    resume: bool = False,
    stopped: Callable[[], bool] = lambda: False,
    report: Callable[[str], None] = lambda line: None,
    progress: Progress = no_progress,
) -> Progressed:
    """Train a method until its time or its number of images is reached, whichever is first.

    The folder gets the settings, the measurements (`metrics.jsonl`), snapshots of the weights (`weights-1000`,
    `weights-2000`, `weights-4000`, ...), the last weights (`weights`) and the state for resuming. A resumed run has the
    batches and the weights of an uninterrupted one.

    Arguments:
      method: Method to train, from random weights.
      data: Training recordings and their inputs.
      settings: Settings of the run.
      out: Folder of the run.
      score: Scores each snapshot. The scores are written to `scores.jsonl`.
      resume: Continue the run in the folder.
      stopped: Asked after every step. If it returns True, the state is saved and the training stops.
      report: Receives a line about the progress every 30 s.
      progress: Displays the training time.

    Returns:
      The last state, the number of images and the training time.

    Raises:
      FloatingPointError: The loss is not finite. The message names the step.
      ValueError: The recordings give no tuples, or the run to resume has other settings.
      OSError: The folder cannot be written, has a run already, or has none to resume.
    """
    with contextlib.ExitStack() as opened:
        opened.enter_context(claimed(out, method, data, settings, resume=resume))
        run = _Run(method, data, settings, out, score, report)
        opened.callback(run.close)
        show = opened.enter_context(progress(f"train {method.name}", math.ceil(settings.seconds)))
        run.start()
        while not run.finished and not stopped():
            run.step()
            show(int(run.now.seconds))
        run.save_last()
        return run.now


class _Run:
    """A run in progress: its state, and what it has written when."""

    def __init__(
        self,
        method: LearnedMethod,
        data: Prepared,
        settings: RunSettings,
        out: Path,
        score: ScoreFn | None,
        report: Callable[[str], None],
    ):
        self._method, self._settings, self._out, self._score, self._report = method, settings, out, score, report
        self._batches = Batches(method, data, seed=settings.seed, out=out)
        self.now = load_state(out, Progressed(new_state(method, seed=settings.seed), 0, 0.0))
        self._key: Array = jax.random.key(settings.seed)
        step = int(self.now.state.step)
        self._metrics = MetricsLog(out / METRICS_FILE, start_step=step)
        self._scores = MetricsLog(out / SCORES_FILE, start_step=step)
        self._ahead = self._batches.from_step(step, lambda: self.now.state)
        self._saved_s = self._reported_s = self.now.seconds
        self._scored_step = -1

    @property
    def finished(self) -> bool:
        """Whether the time or the number of images is reached."""
        images = self._settings.images
        return self.now.seconds >= self._settings.seconds or (0 < images <= self.now.images)

    def start(self) -> None:
        """Compile the step, whose time does not count, and set the weights that the training starts from."""
        if self.finished:
            return
        jax.block_until_ready(self._computed(self._batches.batch(0)))
        if int(self.now.state.step) == 0 and self._method.start is not None:
            started = time.perf_counter()
            variables = self._method.start(self.now.state.variables, self._batches.random_inputs(START_PLACES))
            self.now = Progressed(self.now.state._replace(variables=variables), 0, time.perf_counter() - started)

    def step(self) -> None:
        """Do one step, and write what is due after it."""
        started = time.perf_counter()
        batch = next(self._ahead)
        state, loss = self._computed(batch)
        loss, step = float(loss), int(state.step)
        if not math.isfinite(loss):
            raise FloatingPointError(f"{self._out}: step {step}: the loss is {loss}; the last saved state is intact")
        images, seconds = self.now.images + batch.apart_m.size, self.now.seconds + time.perf_counter() - started
        before, self.now = self.now, Progressed(state, images, seconds)
        snapshots = [n for n in _snapshots(images) if n > before.images]
        if step % LOG_EVERY == 0 or snapshots:
            self._metrics.append(step, {"images": images, "seconds": round(seconds, 3), "loss": loss})
        for snapshot in snapshots:
            self._save_weights(f"{LAST}-{snapshot}")
        self._write_what_is_due(loss, snapshot=bool(snapshots))

    def save_last(self) -> None:
        """Write the last weights, their score and the state."""
        self._save_weights(LAST)
        if self.finished:
            self._score_once()
        self._save()

    def close(self) -> None:
        """Stop reading ahead and close the files."""
        self._ahead.close()
        self._metrics.close()
        self._scores.close()

    def _computed(self, batch: Batch) -> tuple[State, Array]:
        rate = np.float32(self._settings.learning_rate)
        return train_step(self.now.state, batch, self._key, rate, method=self._method)

    def _write_what_is_due(self, loss: float, *, snapshot: bool) -> None:
        if snapshot:
            self._score_once()
        if snapshot or self.now.seconds > self._saved_s + SAVE_EVERY_S:
            self._save()
        if snapshot or self.now.seconds > self._reported_s + REPORT_EVERY_S:
            self._reported_s = self.now.seconds
            step, images = int(self.now.state.step), self.now.images
            self._report(f"step {step}: {images} images, {self.now.seconds:.0f} s, loss {loss:.4g}")

    def _score_once(self) -> None:
        """Score the weights, unless that was done after the same step."""
        step = int(self.now.state.step)
        if self._score is None or step == self._scored_step:
            return
        self._scored_step = step
        found = self._score(self.now.state.variables)
        self._scores.append(step, {"images": self.now.images, "seconds": round(self.now.seconds, 3), **found})
        self._report(", ".join(f"{name} {value:.3f}" for name, value in found.items()))

    def _save_weights(self, name: str) -> None:
        about = {"images": self.now.images, "seconds": round(self.now.seconds, 3), "settings": asdict(self._settings)}
        save_variables(self._out / name, self._method, self.now.state.variables, about)

    def _save(self) -> None:
        self._metrics.sync()
        self._scores.sync()
        save_state(self._out, self.now)
        self._batches.drop_before(int(self.now.state.step))
        self._saved_s = self.now.seconds


def _snapshots(images: int) -> Iterator[int]:
    """Yield the numbers of images at which snapshots are due, up to `images`."""
    due = FIRST_SNAPSHOT
    while due <= images:
        yield due
        due *= 2
