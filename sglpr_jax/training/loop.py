"""The training loop: steps, measurements, scores and checkpoints. It can be interrupted and resumed."""

import contextlib
import math
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import jax
import numpy as np
from jax.sharding import Mesh

from sglpr_jax.models.params import Params
from sglpr_jax.training.batch_queue import BatchQueue, BatchSource
from sglpr_jax.training.callbacks import Callback
from sglpr_jax.training.checkpoint import Checkpoints
from sglpr_jax.training.config import TrainConfig
from sglpr_jax.training.devices import data_mesh, own_copy, replicate, split
from sglpr_jax.training.hosts import is_first_host, of_first_host, on_all_hosts, on_any_host
from sglpr_jax.training.metrics_log import MetricsLog
from sglpr_jax.training.state import TrainState, new_state
from sglpr_jax.training.step import train_step

CHECKPOINTS = "checkpoints"
METRICS_FILE = "metrics.jsonl"

ScoreFn = Callable[[Params], dict[str, float]]
"""Scores weights. The entry "score" selects the best checkpoint."""


def run_steps(
    config: TrainConfig,
    source: BatchSource,
    folder: Path,
    *,
    score: ScoreFn,
    start_from: Params | None = None,
    resume: bool = False,
    callback: Callback | None = None,
    stopped: Callable[[], bool] = lambda: False,
) -> TrainState:
    """Train until `config.steps` steps are done or `stopped()` returns true, and return the state.

    Args:
        source: Source of this host's part of each batch. All devices share a step.
        folder: Folder for metrics and checkpoints.
        score: Scores the weights every `config.score_every` steps.
        start_from: Initial weights of a new run. None: random weights.
        resume: Continue from the newest checkpoint, if there is one.
        callback: Receives the measurements.
        stopped: Called after every step.

    Raises:
        FloatingPointError: The loss is not finite. The message names the step and the places of its batch.
        OSError: Metrics or a checkpoint cannot be written.
        ValueError: The devices cannot share a step (`data_mesh`).
    """
    mesh = data_mesh(config)
    callback = callback if callback is not None and is_first_host() else Callback()
    folder.mkdir(parents=True, exist_ok=True)
    with contextlib.ExitStack() as opened:
        checkpoints = opened.enter_context(contextlib.closing(Checkpoints(folder / CHECKPOINTS)))
        go_on = resume and checkpoints.latest_step() is not None
        state = replicate(checkpoints.restore(config) if go_on else new_state(config, params=start_from), mesh)
        unlogged = checkpoints.unlogged() if go_on else []
        start = int(state.step)
        path = folder / METRICS_FILE if is_first_host() else None
        log = opened.enter_context(contextlib.closing(MetricsLog(path, start_step=start)))
        queue = BatchQueue(source, start=start, stop=config.steps, place=lambda batch: split(batch, mesh))
        batches = opened.enter_context(contextlib.closing(queue))
        callback.on_start(start, config.steps)
        steps = _steps(config, mesh, state, source, batches, stopped, unlogged)
        for state, measured in steps:
            step = int(state.step)
            if measured:
                log.append(step, measured)
                callback.on_step(step, measured)
            if _scored(config, step):
                scores = _score_once(score, state.params)
                log.append(step, scores)
                callback.on_score(step, scores)
                log.sync()
                checkpoints.save(state, score=scores["score"])
                callback.on_checkpoint(step)
        log.sync()
        checkpoints.save(state, unlogged=unlogged)
    return state


def checkpoint_steps(folder: Path) -> list[int]:
    """Return the steps of all complete checkpoints of the run in `folder`, in order."""
    return sorted(int(path.name) for path in (folder / CHECKPOINTS).glob("*") if path.name.isdecimal())


def best_params(folder: Path, config: TrainConfig) -> Params:
    """Return the weights with the best score of the run in `folder`."""
    checkpoints = Checkpoints(folder / CHECKPOINTS)
    try:
        return checkpoints.best_params(config)
    finally:
        checkpoints.close()


def _steps(
    config: TrainConfig,
    mesh: Mesh,
    state: TrainState,
    source: BatchSource,
    batches: BatchQueue,
    stopped: Callable[[], bool],
    unlogged: list[dict[str, float]],
) -> Iterator[tuple[TrainState, dict[str, float]]]:
    """Train; every `log_every` steps and before every score, yield the state and the mean measurements since the last
    yield.

    `unlogged` holds the measurements of the steps since then. A stop in between yields the state without measurements,
    so that the log lines are those of an uninterrupted run. The first measurements have no speed, because every process
    compiles the step first.
    """
    since, waited, made, stop, compiled = time.perf_counter(), 0.0, 0, False, False
    while int(state.step) < config.steps and not stop:
        batches.prepare(own_copy(state.params))
        asked = time.perf_counter()
        batch = on_all_hosts(lambda: next(batches))
        waited += time.perf_counter() - asked
        with jax.set_mesh(mesh):
            state, metrics = train_step(state, batch, config=config)
        unlogged.append({name: float(value) for name, value in jax.device_get(metrics).items()})
        made, step, stop = made + 1, int(state.step), on_any_host(stopped())
        _require_finite(unlogged[-1], step, source)
        if step % config.log_every == 0 or _scored(config, step):
            seconds = time.perf_counter() - since
            times = {"steps_per_second": made / seconds, "data_wait": waited / seconds} if compiled else {}
            means = {name: float(np.mean([measured[name] for measured in unlogged])) for name in unlogged[-1]}
            unlogged.clear()
            yield state, means | times
            since, waited, made, compiled = time.perf_counter(), 0.0, 0, True
        elif stop:
            yield state, {}


def _scored(config: TrainConfig, step: int) -> bool:
    """Whether a score and a checkpoint follow a step."""
    return step % config.score_every == 0 or step == config.steps


def _score_once(score: ScoreFn, params: Params) -> dict[str, float]:
    """Compute the scores on the first host. The other hosts receive the entry "score", which selects checkpoints."""
    own = on_all_hosts(lambda: score(own_copy(params)) if is_first_host() else {"score": 0.0})
    return own | {"score": of_first_host(own["score"])}


def _require_finite(metrics: dict[str, float], step: int, source: BatchSource) -> None:
    broken = [name for name, value in metrics.items() if not math.isfinite(value)]
    if broken:
        places = source.places(step - 1)
        batch = f" (batch: {places})" if places else ""
        raise FloatingPointError(f"step {step}: {', '.join(broken)} not finite{batch}; the last checkpoint is intact")
