"""The training loop: steps, measurements, scores, checkpoints; it can be interrupted and resumed."""

import time
from collections.abc import Callable, Iterator
from pathlib import Path

import jax
import numpy as np
from jax.sharding import Mesh
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from sglpr_jax.data.batch import Batch
from sglpr_jax.data.loader import read_ahead
from sglpr_jax.models.sglpr import Params
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


def train(
    config: TrainConfig,
    make_batch: Callable[[int], Batch],
    folder: Path,
    *,
    score: ScoreFn,
    resume: bool = False,
    stopped: Callable[[], bool] = lambda: False,
) -> TrainState:
    """Train until `config.steps`, or until `stopped()`; `make_batch(step)` gives each step's batch (the host's part).

    All devices share a step. Writes metrics and checkpoints under `folder`; with `resume` it goes on from the newest
    one, if there is one yet. Raises FloatingPointError, naming the step, when the loss is no longer finite; ValueError
    where the devices cannot share a step (`data_mesh`).
    """
    mesh = data_mesh(config)
    folder.mkdir(parents=True, exist_ok=True)
    checkpoints = Checkpoints(folder / CHECKPOINTS)
    go_on = resume and checkpoints.latest_step() is not None
    state = replicate(checkpoints.restore(config) if go_on else new_state(config), mesh)
    start = int(state.step)
    log = MetricsLog(folder / METRICS_FILE if is_first_host() else None, start_step=start)
    batches = read_ahead(lambda step: split(make_batch(step), mesh), start=start, stop=config.steps)
    try:
        with _progress() as progress:
            bar = progress.add_task("train", total=config.steps, completed=start, terms="")
            for state, measured in _steps(config, mesh, state, batches, stopped):  # noqa: B020 - state in, state out
                progress.update(bar, completed=int(state.step), terms=_terms(measured))
                log.append(int(state.step), measured)
                if int(state.step) % config.score_every == 0 or int(state.step) == config.steps:
                    scores = _score_once(score, state.params)
                    log.append(int(state.step), scores)
                    checkpoints.save(state, score=scores["score"])
        checkpoints.save(state)
    finally:
        batches.close()
        checkpoints.close()
        log.close()
    return state


def _steps(
    config: TrainConfig, mesh: Mesh, state: TrainState, batches: Iterator[Batch], stopped: Callable[[], bool]
) -> Iterator[tuple[TrainState, dict[str, float]]]:
    """Make steps; yield the state with the mean measurements since the last time, every `log_every` steps."""
    since, measured, waited, stop = time.perf_counter(), [], 0.0, False
    while int(state.step) < config.steps and not stop:
        asked = time.perf_counter()
        batch = on_all_hosts(lambda: next(batches))
        waited += time.perf_counter() - asked
        with jax.set_mesh(mesh):
            state, metrics = train_step(state, batch, config=config)
        measured.append(jax.device_get(metrics))
        step, stop = int(state.step), on_any_host(stopped())
        _require_finite(measured[-1], step)
        if step % config.log_every == 0 or step % config.score_every == 0 or step == config.steps or stop:
            seconds = time.perf_counter() - since
            means = {name: float(np.mean([m[name] for m in measured])) for name in metrics}
            yield state, means | {"steps_per_second": len(measured) / seconds, "data_wait": waited / seconds}
            since, measured, waited = time.perf_counter(), [], 0.0


def _score_once(score: ScoreFn, params: Params) -> dict[str, float]:
    """The scores, taken by the first host; the others learn the one that tells checkpoints apart."""
    own = on_all_hosts(lambda: score(own_copy(params)) if is_first_host() else {"score": 0.0})
    return own | {"score": of_first_host(own["score"])}


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
        disable=not (Console(stderr=True).is_terminal and is_first_host()),
    )


def _terms(measured: dict[str, float]) -> str:
    shown = ("loss", "triplet", "cross_entropy", "dice", "violations", "steps_per_second")
    return "  ".join(f"{name} {measured[name]:.3g}" for name in shown if name in measured)
