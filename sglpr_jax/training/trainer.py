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
from sglpr_jax.training.checkpoint import Checkpoints
from sglpr_jax.training.devices import any_host, host_copy, is_first_host, on_all_hosts, replicate, split_over_devices
from sglpr_jax.training.metrics_log import MetricsLog
from sglpr_jax.training.run_folder import CHECKPOINTS
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
    """Training time in seconds after which a checkpoint is written. One is also written with each score."""
    steps: int = sys.maxsize
    images: int = sys.maxsize
    seconds: float = math.inf
    """Limits of the run. The first one that is reached ends it."""
    costs: bool = False
    """Write images and seconds of `Trained` in every line of metrics and scores, and scores to a file of their own."""

    def is_over(self, run: Trained) -> bool:
        """Whether a limit is reached."""
        return int(run.state.step) >= self.steps or run.images >= self.images or run.seconds >= self.seconds

    def is_scored(self, before: Trained, after: Trained) -> bool:
        """Whether a score and a checkpoint follow the step from `before` to `after`."""
        is_regular = int(after.state.step) % self.score_every == 0
        return is_regular or any(self.snapshots(before, after)) or self.is_over(after)

    def snapshots(self, before: Trained, after: Trained) -> Iterator[int]:
        """Yield the numbers of images of the snapshots that became due in the step from `before` to `after`."""
        snapshot = self.first_snapshot
        while 0 < snapshot <= after.images:
            if snapshot > before.images:
                yield snapshot
            snapshot *= 2


class Trainer:
    """A run in progress. A resumed run continues with the weights and the lines of the log of an uninterrupted one."""

    def __init__(
        self,
        network: PlaceNetwork,
        source: TupleBatches,
        folder: Path,
        schedule: Schedule,
        *,
        mesh: Mesh,
        first_state: Callable[[], TrainState],
        score: Callable[[TrainState], Mapping[str, float]],
        save_snapshot: Callable[[Trained, int], object] = lambda run, images: None,
        resume: bool = False,
        callback: Callback | None = None,
    ):
        """Open a run in a folder, for metrics and checkpoints.

        Arguments:
          source: Source of this host's part of each batch.
          mesh: Devices, which share a step.
          first_state: Returns the state of a new run.
          score: Scores the weights of a state. Only the first host calls it.
          save_snapshot: `(run, images)`: saves the weights of the snapshot with this number of images.
          resume: Continue from the newest checkpoint, if there is one.
        """
        self._network, self._source, self._schedule, self._mesh = network, source, schedule, mesh
        self._compute_score, self._save_snapshot = score, save_snapshot
        self._callback = callback if callback is not None and is_first_host() else Callback()
        self._checkpoints = Checkpoints(folder / CHECKPOINTS)
        if resume and self._checkpoints.latest_step is not None:
            state, about = self._checkpoints.restore(jax.eval_shape(network.new_state))
        else:
            state, about = first_state(), {}
        self._run = Trained(replicate(state, mesh), about.get("images", 0), about.get("seconds", 0.0))
        self._unlogged_metrics: list[dict[str, float]] = about.get("unlogged", [])
        """Metrics of each step since the last line of the log. Checkpoints store them, too."""
        self._last_checkpoint_s = self._run.seconds
        self._has_logged = False
        """Whether this process has logged a line. Until then, its time includes the compilation of the step."""
        start = int(state.step)
        self._scores_file = SCORES_FILE if schedule.costs else METRICS_FILE
        log_files = {METRICS_FILE, self._scores_file} if is_first_host() else set()
        self._logs = {name: MetricsLog(folder / name, start_step=start) for name in log_files}
        self._batches = batches_in_order(
            source,
            lambda: host_copy(self._run.state),
            start=start,
            stop=schedule.steps,
            to_devices=lambda batch: split_over_devices(batch, mesh),
        )
        self._callback.on_start(start, schedule.steps)

    def train(self, stopped: Callable[[], bool] = lambda: False) -> Trained:
        """Train until a limit of the schedule is reached or `stopped()`, asked after every step, returns true.

        Writes measurements, scores and checkpoints by the schedule and a checkpoint at the end, and closes the files.

        Raises FloatingPointError, with the step and the scans of its batch, if the loss is not finite, and OSError if a
        file cannot be written.
        """
        try:
            self._restart_clock()
            is_stopped = False
            while not self._schedule.is_over(self._run) and not is_stopped:
                before = self._run
                self._step()
                is_stopped = any_host(stopped())
                self._require_finite()
                self._write_due(before)
            self._save_checkpoint()
        finally:
            self._batches.close()
            for log in self._logs.values():
                log.close()
        return self._run

    def _restart_clock(self) -> None:
        """Begin to measure the speed for the next line of the log."""
        self._clock_start_s, self._waited_s, self._clocked_steps = time.perf_counter(), 0.0, 0

    def _step(self) -> None:
        """Make one step and add its metrics, images and seconds. The first step of a process compiles: 0 seconds."""
        step_start_s = time.perf_counter()
        batch = on_all_hosts(lambda: next(self._batches))
        self._waited_s += time.perf_counter() - step_start_s
        with jax.set_mesh(self._mesh):
            state, metrics = train_step(self._run.state, batch, network=self._network)
        self._unlogged_metrics.append({name: float(value) for name, value in jax.device_get(metrics).items()})
        is_first_step = not self._has_logged and self._clocked_steps == 0
        step_s = 0.0 if is_first_step else time.perf_counter() - step_start_s
        self._run = Trained(state, self._run.images + self._network.images, self._run.seconds + step_s)
        self._clocked_steps += 1

    def _write_due(self, before: Trained) -> None:
        """Write the measurements, scores, snapshots and checkpoints that are due after the step since `before`."""
        schedule, step = self._schedule, int(self._run.state.step)
        is_scored = schedule.is_scored(before, self._run)
        if step % schedule.log_every == 0 or is_scored:
            self._log_metrics(step)
        if is_scored:
            for images in schedule.snapshots(before, self._run):
                self._save_snapshot(self._run, images)
            state = self._run.state
            scores = on_all_hosts(lambda: self._compute_score(host_copy(state)) if is_first_host() else {})
            if scores:
                self._callback.on_score(step, self._log(self._scores_file, scores))
            self._save_checkpoint()
        elif self._run.seconds >= self._last_checkpoint_s + schedule.save_every_s:
            self._save_checkpoint()
        if not self._unlogged_metrics:  # a line was logged
            self._restart_clock()

    def _log_metrics(self, step: int) -> None:
        """Log the means since the last line. The first line of a process has no speed: its first step compiles."""
        seconds = time.perf_counter() - self._clock_start_s
        names = self._unlogged_metrics[-1]
        values = {name: float(np.mean([metrics[name] for metrics in self._unlogged_metrics])) for name in names}
        if self._has_logged:
            values |= {"steps_per_second": self._clocked_steps / seconds, "data_wait": self._waited_s / seconds}
        self._unlogged_metrics.clear()
        self._has_logged = True
        self._callback.on_step(step, self._log(METRICS_FILE, values))

    def _log(self, file: str, values: Mapping[str, float]) -> dict[str, float]:
        """Append values, and the costs of the run if the schedule asks for them, to a log. Returns what is logged."""
        costs = {"images": float(self._run.images), "seconds": round(self._run.seconds, 3)}
        logged = {**costs, **values} if self._schedule.costs else dict(values)
        if file in self._logs:  # only on the first host
            self._logs[file].append(int(self._run.state.step), logged)
        return logged

    def _save_checkpoint(self) -> None:
        """Flush the logs to disk, because a checkpoint must not be ahead of them, and write a checkpoint."""
        for log in self._logs.values():
            log.sync()
        about = {"unlogged": self._unlogged_metrics, "images": self._run.images, "seconds": self._run.seconds}
        self._checkpoints.save(host_copy(self._run.state), about)
        self._last_checkpoint_s = self._run.seconds

    def _require_finite(self) -> None:
        """Raise FloatingPointError if a metric of the last step is not finite."""
        step = int(self._run.state.step)
        broken = [name for name, value in self._unlogged_metrics[-1].items() if not math.isfinite(value)]
        if broken:
            scan_names = self._source.scan_names(step - 1)
            batch = f" (batch: {scan_names})" if scan_names else ""
            names = ", ".join(broken)
            raise FloatingPointError(f"step {step}: {names} not finite{batch}; the last checkpoint is intact")
