"""The training loop of every network: steps, measurements, scores and checkpoints. It resumes a run exactly."""

import dataclasses
import math
import sys
import time
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import NamedTuple

import jax
import numpy as np
from jax.sharding import Mesh

from sglpr_jax.training.batch_source import TupleBatches, batches_in_order
from sglpr_jax.training.callbacks import Callback
from sglpr_jax.training.checkpoint import CHECKPOINTS, Checkpoints
from sglpr_jax.training.devices import host_copy, is_first_host, on_all_hosts, on_any_host, replicate, split
from sglpr_jax.training.metrics_log import MetricsLog
from sglpr_jax.training.step import PlaceNetwork, TrainState, train_step

METRICS_FILE, SCORES_FILE = "metrics.jsonl", "scores.jsonl"


class Trained(NamedTuple):
    """State of a run and its cost."""

    state: TrainState
    images: int = 0
    """Number of images that the network has been trained with. An image counts each time that it is used."""
    seconds: float = 0.0
    """Training time in seconds, without scores and without the first step of each process, which compiles."""


@dataclasses.dataclass(frozen=True)
class Schedule:
    """When a run measures, scores its weights and ends."""

    log_every: int
    """Number of steps between two lines of the metrics."""
    score_every: int = sys.maxsize
    """Number of steps between two scores."""
    first_snapshot: int = 0
    """Number of images at the first snapshot, which is scored, too. Each further one has twice as many. 0: none."""
    save_every_s: float = math.inf
    """Training time between two checkpoints in seconds, beside those of the scores."""
    steps: int = sys.maxsize
    images: int = sys.maxsize
    seconds: float = math.inf
    """Limits of the run. The first one that is reached ends it."""
    costs: bool = False
    """State images and seconds in every line of the metrics and of the scores, which then have a file of their own."""

    def is_over(self, run: Trained) -> bool:
        """Whether a limit is reached."""
        return int(run.state.step) >= self.steps or run.images >= self.images or run.seconds >= self.seconds

    def is_scored(self, before: Trained, run: Trained) -> bool:
        """Whether a score and a checkpoint follow the step between two states."""
        due = int(run.state.step) % self.score_every == 0 or any(self.snapshots(before, run))
        return due or self.is_over(run)

    def snapshots(self, before: Trained, run: Trained) -> Iterator[int]:
        """Yield the numbers of images at which snapshots became due in the step between two states."""
        due = self.first_snapshot
        while 0 < due <= run.images:
            if due > before.images:
                yield due
            due *= 2


class Trainer:
    """A run in progress: its state, its open files, and the measurements since the last line of the metrics.

    A stop between two lines saves the measurements since then, so the lines are those of an uninterrupted run.
    """

    def __init__(
        self,
        network: PlaceNetwork,
        source: TupleBatches,
        folder: Path,
        schedule: Schedule,
        *,
        mesh: Mesh,
        begin: Callable[[], TrainState],
        score: Callable[[TrainState], Mapping[str, float]],
        save_snapshot: Callable[[Trained, int], object] = lambda run, images: None,
        resume: bool = False,
        callback: Callback | None = None,
    ):
        """Open a run.

        Arguments:
          network: Network to train.
          source: Source of this host's part of each batch.
          folder: Folder for metrics and checkpoints.
          schedule: Limits, and moments of measurements, scores and checkpoints.
          mesh: Devices, which share a step.
          begin: Returns the state of a new run.
          score: Scores the weights, on the first host.
          save_snapshot: Saves the weights of a snapshot, whose number of images it receives.
          resume: Continue from the newest checkpoint, if there is one.
          callback: Receives the measurements.
        """
        self._network, self._source, self._schedule, self._mesh = network, source, schedule, mesh
        self._compute_score, self._save_snapshot = score, save_snapshot
        self._callback = callback if callback is not None and is_first_host() else Callback()
        self._checkpoints = Checkpoints(folder / CHECKPOINTS)
        if resume and self._checkpoints.latest_step is not None:
            state, about = self._checkpoints.restore(jax.eval_shape(network.new_state))
        else:
            state, about = begin(), {}
        self._run = Trained(replicate(state, mesh), about.get("images", 0), about.get("seconds", 0.0))
        self._unlogged: list[dict[str, float]] = about.get("unlogged", [])
        self._saved_s, self._compiled = self._run.seconds, False
        start, self._scores_file = int(state.step), SCORES_FILE if schedule.costs else METRICS_FILE
        names = {METRICS_FILE, self._scores_file} if is_first_host() else set()
        self._logs = {name: MetricsLog(folder / name, start_step=start) for name in names}
        self._batches = batches_in_order(
            source,
            lambda: host_copy(self._run.state),
            start=start,
            stop=schedule.steps,
            place=lambda batch: split(batch, mesh),
        )
        self._callback.on_start(start, schedule.steps)

    def train(self, stopped: Callable[[], bool] = lambda: False) -> Trained:
        """Train until a limit of the schedule is reached or `stopped()`, asked after every step, returns true.

        Writes what is due after each step and a checkpoint at the end, and closes the files.

        Raises:
          FloatingPointError: The loss is not finite. The message names the step and the places of its batch.
          OSError: Metrics or a checkpoint cannot be written.
        """
        try:
            self._start_clock()
            stop = False
            while not self._schedule.is_over(self._run) and not stop:
                before = self._run
                self._step()
                stop = on_any_host(stopped())
                self._require_finite()
                self._write_due(before)
            self._save()
        finally:
            self._batches.close()
            for log in self._logs.values():
                log.close()
        return self._run

    def _start_clock(self) -> None:
        self._since, self._waited, self._steps = time.perf_counter(), 0.0, 0

    def _step(self) -> None:
        begun = time.perf_counter()
        batch = on_all_hosts(lambda: next(self._batches))
        self._waited += time.perf_counter() - begun
        with jax.set_mesh(self._mesh):
            state, metrics = train_step(self._run.state, batch, network=self._network)
        self._unlogged.append({name: float(value) for name, value in jax.device_get(metrics).items()})
        spent = time.perf_counter() - begun if self._compiled or self._steps else 0.0
        self._run = Trained(state, self._run.images + self._network.images, self._run.seconds + spent)
        self._steps += 1

    def _write_due(self, before: Trained) -> None:
        """Write the measurements, scores, snapshots and checkpoints that are due after the step since `before`."""
        schedule, step = self._schedule, int(self._run.state.step)
        scored = schedule.is_scored(before, self._run)
        if step % schedule.log_every == 0 or scored:
            self._measure(step)
        if scored:
            for images in schedule.snapshots(before, self._run):
                self._save_snapshot(self._run, images)
            state = self._run.state
            scores = on_all_hosts(lambda: self._compute_score(host_copy(state)) if is_first_host() else {})
            if scores:
                self._callback.on_score(step, self._log(self._scores_file, scores))
            self._save()
            self._callback.on_checkpoint(step)
        elif self._run.seconds >= self._saved_s + schedule.save_every_s:
            self._save()
        if not self._unlogged:
            self._start_clock()

    def _measure(self, step: int) -> None:
        """Log the means since the last line. The first line of a process has no speed: its first step compiles."""
        seconds = time.perf_counter() - self._since
        values = {name: float(np.mean([metrics[name] for metrics in self._unlogged])) for name in self._unlogged[-1]}
        if self._compiled:
            values |= {"steps_per_second": self._steps / seconds, "data_wait": self._waited / seconds}
        self._unlogged.clear()
        self._compiled = True
        self._callback.on_step(step, self._log(METRICS_FILE, values))

    def _log(self, name: str, values: Mapping[str, float]) -> dict[str, float]:
        costs = {"images": float(self._run.images), "seconds": round(self._run.seconds, 3)}
        measured = {**(costs if self._schedule.costs else {}), **values}
        if name in self._logs:
            self._logs[name].append(int(self._run.state.step), measured)
        return measured

    def _save(self) -> None:
        """Write a checkpoint, which must not be ahead of the logs."""
        for log in self._logs.values():
            log.sync()
        about = {"unlogged": self._unlogged, "images": self._run.images, "seconds": self._run.seconds}
        self._checkpoints.save(host_copy(self._run.state), about)
        self._saved_s = self._run.seconds

    def _require_finite(self) -> None:
        step = int(self._run.state.step)
        broken = [name for name, value in self._unlogged[-1].items() if not math.isfinite(value)]
        if broken:
            places = self._source.places(step - 1)
            batch = f" (batch: {places})" if places else ""
            raise FloatingPointError(
                f"step {step}: {', '.join(broken)} not finite{batch}; the last checkpoint is intact"
            )
