"""A training in calls of some minutes: each goes on where the last one stopped, and tests what there is."""

import dataclasses
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax

from benchmarks.gpu.small_results import half_fits
from benchmarks.speed.throughput import about, configured
from sglpr_jax.data.training_recordings import leave_one_out
from sglpr_jax.evaluation.final_test import final_test
from sglpr_jax.files import read_json, write_json
from sglpr_jax.models.params import Params
from sglpr_jax.models.weights_file import save
from sglpr_jax.training.config import TrainConfig
from sglpr_jax.training.loop import METRICS_FILE
from sglpr_jax.training.metrics_log import read_metrics
from sglpr_jax.training.presets import load_preset
from sglpr_jax.training.progress_bar import ProgressBar
from sglpr_jax.training.recipe import TrainResult, train
from sglpr_jax.training.run_folder import CONFIG_FILE

SUMMARY_FILE = "summary.json"
MOST_LINES = 2000
"""Of the measurements in a summary; the run's folder has all."""


@dataclasses.dataclass(frozen=True)
class TrainJob:
    """What is trained on what; the same at every call, but for the number of steps."""

    data: Path
    preset: str
    out: Path
    test: str
    """The recording that is tested on, and never trained on."""
    compute: str
    """float32 or bfloat16."""
    chunk: int | None
    """Images through the network at a time, 0: all. None: the preset's."""
    steps: int | None
    """None: the preset's."""
    packs: Path | None
    """A folder where recordings are packed, to be read faster."""

    @property
    def config(self) -> TrainConfig:
        """The preset, changed so. Raises ValueError where there is none, or it cannot be changed so."""
        preset = configured(load_preset(self.preset), self.compute, None)
        changes = {"chunk": self.chunk, "steps": self.steps}
        return dataclasses.replace(preset, **{name: value for name, value in changes.items() if value is not None})


def train_preset(job: TrainJob, results: Path, stopped: Callable[[], bool]) -> TrainResult:
    """Train until all steps are made or `stopped`, test what there is, and write a summary and small weights.

    The summary is RUN.json in `results`, RUN being the name of the run's folder; weights go to the folder RUN there if
    they fit as float16. Nothing is tested again where no step was made since. Raises as `train` and `final_test` do.
    """
    recordings, test = leave_one_out(job.data, job.test)
    settings = {"data": str(job.data), "preset": job.preset, "test": job.test}
    result = train(
        job.config,
        recordings,
        out=job.out,
        test=test,
        resume=(job.out / CONFIG_FILE).exists(),
        cache=job.packs,
        callback=ProgressBar(),
        stopped=stopped,
        settings=settings,
    )
    path = job.out / SUMMARY_FILE
    summary = read_json(path) if path.exists() else {}
    if summary.get("steps_made") != result.steps:
        scores = final_test(result.params, test, job.out / "test", methods=()).to_json()
        summary = {**settings, "steps_made": result.steps, "scores": scores, **about()}
    summary |= _how_it_went(result) | {"weights": _hand_out(result.params, job.out, results)}
    write_json(path, summary)
    write_json(results / f"{job.out.name}.json", summary)
    return result


def _how_it_went(result: TrainResult) -> dict[str, Any]:
    """Steps, speed and measurements."""
    config, speed = result.config, result.throughput
    return {
        "steps": config.steps,
        "finished": result.finished,
        "compute": config.model.compute,
        "tuples": config.tuples,
        "chunk": config.chunk,
        "speed": None if speed is None else dataclasses.asdict(speed),
        "metrics": _thinned(read_metrics(result.folder / METRICS_FILE)),
    }


def _thinned(lines: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """All scores, and of the other lines every n-th."""
    every = math.ceil(len(lines) / MOST_LINES)
    return [line for i, line in enumerate(lines) if "score" in line or i % every == 0]


def _hand_out(params: Params, run: Path, results: Path) -> str:
    """Write the weights where they fit; says where they are."""
    parameters = sum(leaf.size for leaf in jax.tree.leaves(params.weights))
    if not half_fits(parameters):
        return f"in the run's folder alone: {parameters} parameters, as float16 {2 * parameters / 1e6:.0f} MB"
    save(params, results / run.name, half=True)
    return f"{run.name}, as float16: {parameters} parameters"
