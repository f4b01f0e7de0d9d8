"""The training loop of every network: steps, measurements, scores and checkpoints. It resumes a run exactly."""

import contextlib
import dataclasses
import math
import sys
import time
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np
from jax.sharding import Mesh

from sglpr_jax.training.batch_queue import BatchQueue, BatchSource
from sglpr_jax.training.callbacks import Callback
from sglpr_jax.training.checkpoint import Checkpoints
from sglpr_jax.training.devices import is_first_host, on_all_hosts, on_any_host, own_copy, replicate, split
from sglpr_jax.training.metrics_log import MetricsLog
from sglpr_jax.training.step import PlaceNetwork, TrainState, train_step

CHECKPOINTS = "checkpoints"
METRICS_FILE = "metrics.jsonl"


class Trained(NamedTuple):
    """State of a run and what it cost."""

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
    """Whether the lines of the metrics and of the scores state images and seconds."""
    scores_file: str = METRICS_FILE
    """File of the scores."""

    def is_over(self, run: Trained) -> bool:
        """Whether a limit is reached."""
        return int(run.state.step) >= self.steps or run.images >= self.images or run.seconds >= self.seconds

    def is_scored(self, before: Trained, run: Trained) -> bool:
        """Whether a score and a checkpoint follow a step."""
        due = int(run.state.step) % self.score_every == 0 or any(self.snapshots(before, run))
        return due or self.is_over(run)

    def snapshots(self, before: Trained, run: Trained) -> Iterator[int]:
        """Yield the numbers of images at which snapshots became due in a step."""
        due = self.first_snapshot
        while 0 < due <= run.images:
            if due > before.images:
                yield due
            due *= 2


KeepFn = Callable[[Trained, list[int]], Mapping[str, float]]
"""Scores the weights, and keeps those of the snapshots that are due."""


def run_steps(
    network: PlaceNetwork,
    source: BatchSource,
    folder: Path,
    schedule: Schedule,
    *,
    stopped: Callable[[], bool] = lambda: False,
    **options: Any,
) -> Trained:
    """Train until a limit of the schedule is reached or `stopped()` returns true, and return the state.

    Args:
        network: Network to train.
        source: Source of this host's part of each batch. All devices share a step.
        folder: Folder for metrics and checkpoints.
        schedule: Limits, and moments of measurements, scores and checkpoints.
        stopped: Called after every step.
        options: Those of `_Run`.

    Raises:
        FloatingPointError: The loss is not finite. The message names the step and the places of its batch.
        OSError: Metrics or a checkpoint cannot be written.
    """
    with contextlib.closing(_Run(network, source, folder, schedule, **options)) as run:
        run.continue_until(stopped)
    return run.run


class _Run:
    """A run in progress: its state, its open files, and the measurements since the last line of the metrics.

    A stop between two lines saves the measurements since then, so the lines are those of an uninterrupted run.
    """

    def __init__(
        self,
        network: PlaceNetwork,
        source: BatchSource,
        folder: Path,
        schedule: Schedule,
        *,
        mesh: Mesh,
        keep: KeepFn,
        begin: Callable[[], TrainState],
        resume: bool = False,
        callback: Callback | None = None,
    ):
        """Open a run.

        Args:
            network, source, folder, schedule: As in `run_steps`.
            mesh: Devices of the run.
            keep: Called when a score or a snapshot is due, and at the end.
            begin: Returns the state of a new run.
            resume: Continue from the newest checkpoint, if there is one.
            callback: Receives the measurements.
        """
        self._network, self._source, self._schedule, self._mesh, self._keep = network, source, schedule, mesh, keep
        self._callback = callback if callback is not None and is_first_host() else Callback()
        self._checkpoints = Checkpoints(folder / CHECKPOINTS)
        if resume and self._checkpoints.latest_step is not None:
            state, about = self._checkpoints.restore(jax.eval_shape(network.new_state))
        else:
            state, about = begin(), {}
        self.run = Trained(replicate(state, mesh), about.get("images", 0), about.get("seconds", 0.0))
        self._unlogged: list[dict[str, float]] = about.get("unlogged", [])
        self._saved_s, self._compiled = self.run.seconds, False
        start, names = int(state.step), (METRICS_FILE, schedule.scores_file) if is_first_host() else ()
        self._logs = {name: MetricsLog(folder / name, start_step=start) for name in dict.fromkeys(names)}
        self._queue = BatchQueue(source, start=start, stop=schedule.steps, place=lambda batch: split(batch, mesh))
        self._callback.on_start(start, schedule.steps)

    def continue_until(self, stopped: Callable[[], bool]) -> None:
        """Train, and write what is due after each step. At the end, save the state."""
        stop = False
        self._start_clock()
        while not self._schedule.is_over(self.run) and not stop:
            before = self.run
            self._step()
            stop = on_any_host(stopped())
            self._require_finite()
            scored = self._schedule.is_scored(before, self.run)
            if int(self.run.state.step) % self._schedule.log_every == 0 or scored:
                self._measure()
            if scored:
                self._score(list(self._schedule.snapshots(before, self.run)))
            elif self.run.seconds >= self._saved_s + self._schedule.save_every_s:
                self._save()
            if not self._unlogged:
                self._start_clock()
        self._save()

    def close(self) -> None:
        """Stop reading ahead and close the files."""
        self._queue.close()
        for log in self._logs.values():
            log.close()

    def _start_clock(self) -> None:
        self._since, self._waited, self._made = time.perf_counter(), 0.0, 0

    def _step(self) -> None:
        begun = time.perf_counter()
        self._queue.prepare(lambda: own_copy(self.run.state))
        asked = time.perf_counter()
        batch = on_all_hosts(lambda: next(self._queue))
        self._waited += time.perf_counter() - asked
        with jax.set_mesh(self._mesh):
            state, metrics = train_step(self.run.state, batch, network=self._network)
        self._unlogged.append({name: float(value) for name, value in jax.device_get(metrics).items()})
        spent = time.perf_counter() - begun if self._compiled or self._made else 0.0
        self.run = Trained(state, self.run.images + self._network.images, self.run.seconds + spent)
        self._made += 1

    def _measure(self) -> None:
        """Log the means since the last line. The first line of a process has no speed: its first step compiles."""
        seconds = time.perf_counter() - self._since
        values = {name: float(np.mean([one[name] for one in self._unlogged])) for name in self._unlogged[-1]}
        if self._compiled:
            values |= {"steps_per_second": self._made / seconds, "data_wait": self._waited / seconds}
        self._unlogged.clear()
        self._compiled = True
        self._callback.on_step(int(self.run.state.step), self._log(METRICS_FILE, values))

    def _score(self, snapshots: list[int]) -> None:
        """Score the weights, and save them with their score."""
        scores, step = self._keep(self.run, snapshots), int(self.run.state.step)
        if scores:
            self._callback.on_score(step, self._log(self._schedule.scores_file, scores))
        self._save()
        self._callback.on_checkpoint(step)

    def _log(self, name: str, values: Mapping[str, float]) -> dict[str, float]:
        costs = {"images": float(self.run.images), "seconds": round(self.run.seconds, 3)}
        measured = {**(costs if self._schedule.costs else {}), **values}
        if name in self._logs:
            self._logs[name].append(int(self.run.state.step), measured)
        return measured

    def _save(self) -> None:
        for log in self._logs.values():
            log.sync()
        about = {"unlogged": self._unlogged, "images": self.run.images, "seconds": self.run.seconds}
        self._checkpoints.save(own_copy(self.run.state), about)
        self._saved_s = self.run.seconds

    def _require_finite(self) -> None:
        step = int(self.run.state.step)
        broken = [name for name, value in self._unlogged[-1].items() if not math.isfinite(value)]
        if broken:
            places = self._source.places(step - 1)
            batch = f" (batch: {places})" if places else ""
            raise FloatingPointError(
                f"step {step}: {', '.join(broken)} not finite{batch}; the last checkpoint is intact"
            )
