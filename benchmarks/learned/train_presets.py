"""Trains presets of `bin/train` on the recordings of the learned methods, for the same time.

    python -m benchmarks.learned.train_presets --preset sglpr --seed 0
    python -m benchmarks.learned.train_presets --preset sglpr --seed 0 --no-labels    # without the semantic branch
    python -m benchmarks.learned.train_presets --preset benchmarks/learned/paper-112.py --seconds 9000 \\
        --upright-images 6000 --learning-rate 4e-4

Without --learning-rate, the rate is the best of three short trainings, scored on the held-out town. As for the learned
methods, weights are kept after 1,000, 2,000, 4,000, ... images, an interrupted training is continued, and a finished
one is left alone.
"""

import dataclasses
import itertools
import json
import shutil
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import jax
import numpy as np
import tyro

import sglpr_jax
from benchmarks.learned.clock import UPRIGHT, Clock
from benchmarks.learned.data import HELD_OUT, TRAIN_IMAGES, folders
from sglpr_jax.cli.peers import RATES
from sglpr_jax.cli.runtime import stop_on_signal
from sglpr_jax.data.readers import open_recording, recording_names
from sglpr_jax.data.recording import Recording
from sglpr_jax.files import write_json
from sglpr_jax.retrieval.distances import distance_function
from sglpr_jax.training.config import TrainConfig, without_untrained_head
from sglpr_jax.training.learned.rate_search import RATES_FILE
from sglpr_jax.training.learned.run import FIRST_SNAPSHOT
from sglpr_jax.training.learned.run_files import SCORES_FILE
from sglpr_jax.training.learned.score import recall_at_1
from sglpr_jax.training.recipe import WEIGHTS

RATE_FACTORS = (1 / 3, 1.0, 3.0)
"""Learning rates of the search, as multiples of the preset's."""
OPPOSITE = "08"
"""Name of the recordings whose revisits are in the opposite direction, that is rotated by half a turn."""
ENDLESS = 10**9


@dataclasses.dataclass(frozen=True)
class Settings:
    """Settings of a run."""

    preset: str = "sglpr"
    """Name of a file in configs/, or path of your own file."""
    seed: int = 0
    data: Path = Path("build/learned")
    """Folder of the recordings of `data`."""
    out: Path = Path("build/learned/runs")
    """Folder of the runs, PRESET-SEED."""
    seconds: float = 3600.0
    """Training time, without scores and compilation."""
    images: int = 0
    """Number of images after which the run stops, if its time is not over before; 0: no limit."""
    upright_images: int = 0
    """Number of images, out of all, of a first stage without rotations, on recordings with revisits in the same
    direction."""
    search_seconds: float = 300.0
    """Training time of each of the three learning rates."""
    learning_rate: float | None = None
    """Learning rate. None: the best of the search."""
    labels: bool = True
    """Train the semantic branch."""
    compile_cache: Path = Path("build/learned/compiled")
    """Folder of compiled programs, which all stages share."""

    @property
    def folder(self) -> Path:
        """Folder of the run."""
        return self.out / f"{Path(self.preset).stem}{'' if self.labels else '-no-labels'}-{self.seed}"


def main(settings: Settings) -> None:
    """Train, or continue a run."""
    jax.config.update("jax_compilation_cache_dir", str(settings.compile_cache.absolute()))
    recordings = [one for folder in folders(settings.data, TRAIN_IMAGES) for one in _all(folder)]
    held_out = [one for folder in folders(settings.data, HELD_OUT) for one in _all(folder)]
    rate = settings.learning_rate or _best_rate(settings, recordings, held_out)
    _train(_config(settings, rate), recordings, settings.folder, settings, held_out)


def _all(folder: Path) -> list[Recording]:
    return [open_recording(folder, name) for name in recording_names(folder)]


def _config(settings: Settings, rate: float) -> TrainConfig:
    """Return the preset with the settings of this comparison."""
    config = sglpr_jax.preset(settings.preset)
    optimizer = dataclasses.replace(config.optimizer, learning_rate=rate)
    changes = {"optimizer": optimizer, "seed": settings.seed, "score_every": ENDLESS}
    config = dataclasses.replace(config, **changes)
    if not settings.labels:
        config = dataclasses.replace(config, model=dataclasses.replace(config.model, categories=0))
    return without_untrained_head(config)


def _best_rate(settings: Settings, recordings: list[Recording], held_out: list[Recording]) -> float:
    """Return the learning rate of the highest Recall@1 on the held-out town. Finished trainings are not repeated."""
    folder, scores = settings.folder / RATES, {}
    preset = sglpr_jax.preset(settings.preset).optimizer.learning_rate
    for factor in RATE_FACTORS:
        rate = preset * factor
        short = dataclasses.replace(settings, seconds=settings.search_seconds)
        _train(_config(short, rate), recordings, folder / f"rate-{rate:g}", short, held_out)
        scores[rate] = _scores(folder / f"rate-{rate:g}")[-1]["recall_at_1"]
    best = max(scores, key=lambda rate: scores[rate])
    recalls = {f"{rate:g}": found for rate, found in scores.items()}
    write_json(folder / RATES_FILE, {"seconds": settings.search_seconds, "recall_at_1": recalls, "best": best})
    return best


def _train(
    config: TrainConfig, recordings: list[Recording], folder: Path, settings: Settings, held_out: list[Recording]
) -> None:
    """Train in stages that end where a snapshot is due, until the time or the number of images is reached."""
    per_step = config.tuples * (1 + config.sampling.positives + config.sampling.negatives)
    for images in _ends(settings):
        if any(line["images"] > images - per_step for line in _scores(folder)):
            continue  # the weights of this end, or later ones, are kept already
        upright = images <= settings.upright_images
        run = folder / UPRIGHT if upright else folder
        done = 0 if upright else settings.upright_images
        staged = dataclasses.replace(config, steps=(images - done) // per_step, rotate=not upright)
        clock = Clock(folder, limit_s=settings.seconds)
        if clock.over:
            return
        start_from = folder / UPRIGHT / WEIGHTS if done else None
        stage = [one for one in recordings if not upright or one.name != OPPOSITE]
        with stop_on_signal() as stopped:
            options = {"resume": (run / "config.json").is_file(), "weights": start_from, "callback": clock}
            result = sglpr_jax.train(staged, stage, out=run, stopped=_any(stopped, clock), **options)
        seen = done + result.steps * per_step
        print(f"{run}: {seen} images, {clock.seconds:.0f} s", file=sys.stderr, flush=True)
        if stopped():
            sys.exit(stopped.exit_status)
        _keep(folder, result.params, seen, clock.seconds, held_out)


def _any(stopped: Callable[[], bool], clock: Clock) -> Callable[[], bool]:
    return lambda: stopped() or clock.over


def _ends(settings: Settings) -> Iterator[int]:
    """Yield the numbers of images at which a stage ends."""
    limit = settings.images or ENDLESS
    doubled = itertools.takewhile(lambda n: n < limit, (FIRST_SNAPSHOT * 2**k for k in itertools.count()))
    yield from sorted({*doubled, limit, settings.upright_images} - {0})


def _keep(folder: Path, params: sglpr_jax.Params, images: int, seconds: float, held_out: list[Recording]) -> None:
    """Keep the weights of a snapshot and its score on the held-out town, unless that was done."""
    if any(line["images"] == images for line in _scores(folder)):
        return
    shutil.rmtree(folder / f"weights-{images}", ignore_errors=True)
    sglpr_jax.save(params, folder / f"weights-{images}")
    recall = float(np.mean([_recall(params, recording) for recording in held_out]))
    line = {"images": images, "seconds": round(seconds, 1), "recall_at_1": recall}
    with (folder / SCORES_FILE).open("a") as file:
        print(json.dumps(line), file=file)
    print(f"{folder}: {line}", file=sys.stderr, flush=True)


def _recall(params: sglpr_jax.Params, recording: Recording) -> float:
    file = sglpr_jax.embed(params, recording)
    assert file.positions is not None
    return recall_at_1(file.descriptors, file.positions, file.times, distance_function(file.distance))


def _scores(folder: Path) -> list[dict[str, float]]:
    path = folder / SCORES_FILE
    return [json.loads(line) for line in path.read_text().splitlines()] if path.is_file() else []


if __name__ == "__main__":
    main(tyro.cli(Settings))
