"""The training loop: steps, measurements, scores, checkpoints; it can be interrupted and resumed."""

import time
from collections.abc import Callable, Iterator
from pathlib import Path

import jax
import numpy as np
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from sglpr_jax.data.batch import Batch
from sglpr_jax.models.sglpr import Params
from sglpr_jax.train.batches import Batches, RefreshFn
from sglpr_jax.train.checkpoint import Checkpoints
from sglpr_jax.train.config import TrainConfig
from sglpr_jax.train.metrics_log import MetricsLog
from sglpr_jax.train.state import TrainState, new_state
from sglpr_jax.train.step import train_step

CHECKPOINTS = "checkpoints"
METRICS_FILE = "metrics.jsonl"

ScoreFn = Callable[[Params], dict[str, float]]
"""Measures how good weights are; its "score" tells the best checkpoint."""


def train(
    config: TrainConfig,
    make_batch: Callable[[int], Batch],
    folder: Path,
    *,
    score: ScoreFn,
    refresh: RefreshFn | None = None,
    resume: bool = False,
    stopped: Callable[[], bool] = lambda: False,
) -> TrainState:
    """Train until `config.steps`, or until `stopped()`; `make_batch(step)` gives each step's batch.

    `refresh(step, params)` is called before the first step and before each multiple of `sampling.refresh_steps`.
    Writes metrics and checkpoints under `folder`; with `resume` it goes on from the newest one, if there is one yet.
    Raises FloatingPointError, naming the step, when the loss is no longer finite.
    """
    folder.mkdir(parents=True, exist_ok=True)
    checkpoints = Checkpoints(folder / CHECKPOINTS)
    go_on = resume and checkpoints.latest_step() is not None
    state = checkpoints.restore(config) if go_on else new_state(config)
    start = int(state.step)
    log = MetricsLog(folder / METRICS_FILE, start_step=start)
    every = config.sampling.refresh_steps
    batches = Batches(make_batch, start=start, stop=config.steps, refresh=refresh, refresh_steps=every)
    try:
        with _progress() as progress:
            bar = progress.add_task("train", total=config.steps, completed=start, terms="")
            for state, measured in _steps(config, state, batches, stopped):  # noqa: B020 - state in, state out
                progress.update(bar, completed=int(state.step), terms=_terms(measured))
                log.append(int(state.step), measured)
                if int(state.step) % config.score_every == 0 or int(state.step) == config.steps:
                    scores = score(state.params)
                    log.append(int(state.step), scores)
                    checkpoints.save(state, score=scores.get("score"))
        checkpoints.save(state)
    finally:
        batches.close()
        checkpoints.close()
        log.close()
    return state


def best_params(folder: Path, config: TrainConfig) -> Params:
    """The weights with the best score of the run in `folder`."""
    checkpoints = Checkpoints(folder / CHECKPOINTS)
    try:
        return checkpoints.best_params(config)
    finally:
        checkpoints.close()


def _steps(
    config: TrainConfig, state: TrainState, batches: Batches, stopped: Callable[[], bool]
) -> Iterator[tuple[TrainState, dict[str, float]]]:
    """Make steps; yield the state with the mean measurements since the last time, every `log_every` steps."""
    since, measured, waited, stop = time.perf_counter(), [], 0.0, False
    while int(state.step) < config.steps and not stop:
        batches.prepare(state.params)
        asked = time.perf_counter()
        batch = next(batches)
        waited += time.perf_counter() - asked
        state, metrics = train_step(state, batch, config=config)
        measured.append(jax.device_get(metrics))
        step, stop = int(state.step), stopped()
        _require_finite(measured[-1], step)
        if step % config.log_every == 0 or step % config.score_every == 0 or step == config.steps or stop:
            seconds = time.perf_counter() - since
            means = {name: float(np.mean([m[name] for m in measured])) for name in metrics}
            yield state, means | {"steps_per_second": len(measured) / seconds, "data_wait": waited / seconds}
            since, measured, waited = time.perf_counter(), [], 0.0


def _require_finite(metrics: dict[str, np.ndarray], step: int) -> None:
    broken = [name for name, value in metrics.items() if not np.isfinite(value)]
    if broken:
        raise FloatingPointError(f"step {step}: {', '.join(broken)} not finite; the last checkpoint is intact")


def _progress() -> Progress:
    return Progress(
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeRemainingColumn(),
        TextColumn("{task.fields[terms]}"),
        console=Console(stderr=True),
        disable=not Console(stderr=True).is_terminal,
    )


def _terms(measured: dict[str, float]) -> str:
    shown = ("loss", "triplet", "cross_entropy", "dice", "violations", "steps_per_second")
    return "  ".join(f"{name} {measured[name]:.3g}" for name in shown if name in measured)
