"""The training loop: steps, measurements, scores, checkpoints; it can be interrupted and resumed."""

import contextlib
import math
import time
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path

import jax
import numpy as np
from jax.sharding import Mesh
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from sglpr_jax.data.batch import Batch
from sglpr_jax.models.sglpr import Params
from sglpr_jax.train.batches import Batches, RefreshFn
from sglpr_jax.train.checkpoint import Checkpoints
from sglpr_jax.train.config import TrainConfig
from sglpr_jax.train.devices import data_mesh, own_copy, replicate, split
from sglpr_jax.train.hosts import is_first_host, of_first_host, on_all_hosts, on_any_host
from sglpr_jax.train.metrics_log import MetricsLog
from sglpr_jax.train.state import TrainState, new_state
from sglpr_jax.train.step import train_step

CHECKPOINTS = "checkpoints"
METRICS_FILE = "metrics.jsonl"

ScoreFn = Callable[[Params], dict[str, float]]
"""Measures how good weights are; its "score" tells the best checkpoint."""
RecordFn = Callable[[int, Mapping[str, float]], None]
"""Is told the measurements of a step."""


def train(
    config: TrainConfig,
    make_batch: Callable[[int], Batch],
    folder: Path,
    *,
    score: ScoreFn,
    refresh: RefreshFn | None = None,
    start_from: Params | None = None,
    resume: bool = False,
    stopped: Callable[[], bool] = lambda: False,
    places: Callable[[int], str] | None = None,
    record: RecordFn = lambda step, values: None,
) -> TrainState:
    """Train until `config.steps`, or until `stopped()`; `make_batch(step)` gives each step's batch (the host's part).

    All devices share a step. Writes metrics and checkpoints under `folder`; with `resume` it goes on from the newest
    one, if there is one yet. A new run begins with `start_from`, or with fresh weights. `refresh(step, params)` is
    called before the first step and before each multiple of `sampling.refresh_steps`. `record` is told what the
    metrics are told. Raises FloatingPointError, naming the step and its batch as `places` does, when the loss is no
    longer finite; OSError when metrics or a checkpoint cannot be written; ValueError where the devices cannot share a
    step (`data_mesh`).
    """
    mesh = data_mesh(config)
    folder.mkdir(parents=True, exist_ok=True)
    with contextlib.ExitStack() as opened:
        checkpoints = opened.enter_context(contextlib.closing(Checkpoints(folder / CHECKPOINTS)))
        go_on = resume and checkpoints.latest_step() is not None
        state = replicate(checkpoints.restore(config) if go_on else new_state(config, params=start_from), mesh)
        unlogged = checkpoints.unlogged() if go_on else []
        start = int(state.step)
        path = folder / METRICS_FILE if is_first_host() else None
        log = opened.enter_context(contextlib.closing(MetricsLog(path, start_step=start)))
        parts = Batches(
            lambda step: split(make_batch(step), mesh),
            start=start,
            stop=config.steps,
            refresh=refresh,
            refresh_steps=config.sampling.refresh_steps,
        )
        batches = opened.enter_context(contextlib.closing(parts))
        progress = opened.enter_context(_progress())
        bar = progress.add_task("train", total=config.steps, completed=start, terms="")
        made = _steps(config, mesh, state, batches, stopped, places, unlogged)
        for state, measured in made:
            step = int(state.step)
            if measured:
                progress.update(bar, completed=step, terms=_terms(measured))
                log.append(step, measured)
                record(step, measured)
            if _scored(config, step):
                scores = _score_once(score, state.params)
                log.append(step, scores)
                record(step, scores)
                log.sync()
                checkpoints.save(state, score=scores["score"])
        log.sync()
        checkpoints.save(state, unlogged=unlogged)
    return state


def best_params(folder: Path, config: TrainConfig) -> Params:
    """The weights with the best score of the run in `folder`."""
    checkpoints = Checkpoints(folder / CHECKPOINTS)
    try:
        return checkpoints.best_params(config)
    finally:
        checkpoints.close()


def _steps(
    config: TrainConfig,
    mesh: Mesh,
    state: TrainState,
    batches: Batches,
    stopped: Callable[[], bool],
    places: Callable[[int], str] | None,
    unlogged: list[dict[str, float]],
) -> Iterator[tuple[TrainState, dict[str, float]]]:
    """Make steps; yield the state with the mean measurements since the last time, every `log_every` steps.

    `unlogged` holds the measurements of the steps since then. A stop in between yields the state and no measurements,
    so that the lines are those of a run that was not stopped.
    """
    since, waited, made, stop = time.perf_counter(), 0.0, 0, False
    while int(state.step) < config.steps and not stop:
        batches.prepare(own_copy(state.params))
        asked = time.perf_counter()
        batch = on_all_hosts(lambda: next(batches))
        waited += time.perf_counter() - asked
        with jax.set_mesh(mesh):
            state, metrics = train_step(state, batch, config=config)
        unlogged.append({name: float(value) for name, value in jax.device_get(metrics).items()})
        made, step, stop = made + 1, int(state.step), on_any_host(stopped())
        _require_finite(unlogged[-1], step, places)
        if step % config.log_every == 0 or _scored(config, step):
            seconds = time.perf_counter() - since
            means = {name: float(np.mean([measured[name] for measured in unlogged])) for name in unlogged[-1]}
            unlogged.clear()
            yield state, means | {"steps_per_second": made / seconds, "data_wait": waited / seconds}
            since, waited, made = time.perf_counter(), 0.0, 0
        elif stop:
            yield state, {}


def _scored(config: TrainConfig, step: int) -> bool:
    """Whether a step is followed by a score and a checkpoint."""
    return step % config.score_every == 0 or step == config.steps


def _score_once(score: ScoreFn, params: Params) -> dict[str, float]:
    """The scores, taken by the first host; the others learn the one that tells checkpoints apart."""
    own = on_all_hosts(lambda: score(own_copy(params)) if is_first_host() else {"score": 0.0})
    return own | {"score": of_first_host(own["score"])}


def _require_finite(metrics: dict[str, float], step: int, places: Callable[[int], str] | None) -> None:
    broken = [name for name, value in metrics.items() if not math.isfinite(value)]
    if broken:
        batch = f" (batch: {places(step - 1)})" if places else ""
        raise FloatingPointError(f"step {step}: {', '.join(broken)} not finite{batch}; the last checkpoint is intact")


def _progress() -> Progress:
    return Progress(
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeRemainingColumn(),
        TextColumn("{task.fields[terms]}"),
        console=Console(stderr=True),
        disable=not (Console(stderr=True).is_terminal and is_first_host()),
    )


def _terms(measured: dict[str, float]) -> str:
    shown = ("loss", "triplet", "cross_entropy", "dice", "violations", "steps_per_second")
    return "  ".join(f"{name} {measured[name]:.3g}" for name in shown if name in measured)
