"""Trainings on the same recordings for the same time: networks of other publications, and presets of `bin/train`.

Without --learning-rate, the rate is the best of three short trainings, scored on the held-out town. Weights are kept
after 1,000, 2,000, 4,000, ... images, an interrupted training is continued, and a finished one is left alone.
"""

import dataclasses
import itertools
import json
import os
import shutil
import subprocess
import sys
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

import jax
import numpy as np
import tyro

import sglpr_jax
from benchmarks.learned.data import HELD_OUT, TRAIN, TRAIN_IMAGES, folders, recordings_of
from sglpr_jax.cli.peers import RATES
from sglpr_jax.data.recording import Recording
from sglpr_jax.files import write_json
from sglpr_jax.methods.names import LEARNED_NAMES
from sglpr_jax.models.weights_file import LAST_WEIGHTS
from sglpr_jax.retrieval.distances import distance_function
from sglpr_jax.stop_request import stop_on_signal
from sglpr_jax.training.callbacks import Callback
from sglpr_jax.training.config import TrainConfig, without_untrained_head
from sglpr_jax.training.metrics_log import read_metrics
from sglpr_jax.training.peers import FIRST_SNAPSHOT, RATES_FILE
from sglpr_jax.training.trainer import METRICS_FILE, SCORES_FILE
from sglpr_jax.training.validation import recall_at_1

ONE_CORE = {"JAX_PLATFORMS": "cpu", "XLA_FLAGS": "--xla_cpu_multi_thread_eigen=false intra_op_parallelism_threads=1"}
RATE_FACTORS = (1 / 3, 1.0, 3.0)
"""Learning rates of the search, as multiples of the preset's."""
OPPOSITE = "08"
"""Name of the recordings whose revisits are in the opposite direction, that is rotated by half a turn."""
ENDLESS = 10**9
SPEED = "steps_per_second"
UPRIGHT = "upright"
"""Folder of the first stage, in that of the run."""


def train(
    *,
    data: Path = Path("build/learned"),
    methods: Sequence[str] = LEARNED_NAMES,
    seeds: Sequence[int] = (0, 1),
    seconds: float = 3600.0,
    images: int = 0,
    search_seconds: float = 300.0,
    learning_rate: float | None = None,
) -> None:
    """Train every method with every seed, one after the other. Interrupted trainings are continued.

    Args:
        data: folder of the recordings, and of the runs, runs/METHOD-SEED.
        methods: names of the methods.
        seeds: seeds of weights, tuples and rotations.
        seconds: training time of each run.
        images: number of images after which a run stops, if its time is not over before; 0: no limit.
        search_seconds: training time of each of the three learning rates. Further seeds use the rate of the first.
        learning_rate: rate of all runs, in place of the search.
    """
    (held_out,), out = folders(data, HELD_OUT), data / "runs"
    for method in methods:
        for seed in seeds:
            run, first = out / f"{method}-{seed}", out / f"{method}-{seeds[0]}" / RATES / RATES_FILE
            rate = learning_rate or (json.loads(first.read_text())["best"] if seed != seeds[0] else None)
            command = ["train", method, *folders(data, TRAIN), "--out", run, "--held-out", held_out]
            command += ["--cache", data / "cache", "--seed", seed, "--seconds", seconds, "--images", images]
            command += ["--search-seconds", search_seconds, *(["--resume"] if run.exists() else [])]
            command += [] if rate is None else ["--learning-rate", rate]
            print(run, file=sys.stderr, flush=True)
            program = [sys.executable, "-m", "sglpr_jax.cli", "peers", *map(str, command)]
            subprocess.run(program, check=True, env={**os.environ, **ONE_CORE})


class Clock(Callback):
    """Training time of a run, summed over its stages, without scores and compilation.

    Metrics after a start have no speed. Their steps are counted with the mean speed.
    """

    def __init__(self, folder: Path, *, limit_s: float):
        """Continue the time of the stages in the folder of a run."""
        self._limit_s = limit_s
        self._timed_s, self._timed, self._steps, self._last = 0.0, 0, 0, 0
        for path in filter(Path.is_file, (folder / UPRIGHT / METRICS_FILE, folder / METRICS_FILE)):
            self._last = 0
            for line in read_metrics(path):
                self.on_step(int(line["step"]), line)

    @property
    def seconds(self) -> float:
        """Training time in seconds."""
        return self._timed_s * self._steps / max(self._timed, 1)

    @property
    def is_over(self) -> bool:
        """Whether the time limit is reached."""
        return self.seconds >= self._limit_s

    def on_start(self, step: int, steps: int) -> None:
        self._last = step

    def on_step(self, step: int, values: Mapping[str, float]) -> None:
        new_steps, self._last = step - self._last, step
        self._steps += new_steps
        if SPEED in values:
            self._timed += new_steps
            self._timed_s += new_steps / values[SPEED]


@dataclasses.dataclass(frozen=True)
class Settings:
    """Settings of a run."""

    preset: str = "sglpr"
    """Name of a file in configs/, or path of your own file."""
    seed: int = 0
    data: Path = Path("build/learned")
    """Folder of the recordings of `data`, and of the runs, runs/PRESET-SEED."""
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
    compile_cache: Path = Path("build/learned/compiled")
    """Folder of compiled programs, which all stages share."""

    @property
    def folder(self) -> Path:
        """Folder of the run."""
        return self.data / "runs" / f"{Path(self.preset).stem}-{self.seed}"


def train_preset(settings: tyro.conf.OmitArgPrefixes[Settings]) -> None:
    """Train, or continue a run."""
    jax.config.update("jax_compilation_cache_dir", str(settings.compile_cache.absolute()))
    recordings = [one for folder in folders(settings.data, TRAIN_IMAGES) for one in recordings_of(folder)]
    held_out = [one for folder in folders(settings.data, HELD_OUT) for one in recordings_of(folder)]
    rate = settings.learning_rate or _best_rate(settings, recordings, held_out)
    _train(_config(settings, rate), recordings, settings.folder, settings, held_out)


def _config(settings: Settings, rate: float) -> TrainConfig:
    """Return the preset with the settings of this comparison."""
    config = sglpr_jax.preset(settings.preset)
    optimizer = dataclasses.replace(config.optimizer, learning_rate=rate)
    changes = {"optimizer": optimizer, "seed": settings.seed, "score_every": ENDLESS}
    return without_untrained_head(dataclasses.replace(config, **changes))


def _best_rate(settings: Settings, recordings: list[Recording], held_out: list[Recording]) -> float:
    """Return the learning rate of the highest Recall@1 on the held-out town. Finished trainings are not repeated."""
    folder, recalls = settings.folder / RATES, dict[float, float]()
    short = dataclasses.replace(settings, seconds=settings.search_seconds)
    for factor in RATE_FACTORS:
        rate = sglpr_jax.preset(settings.preset).optimizer.learning_rate * factor
        _train(_config(short, rate), recordings, folder / f"rate-{rate:g}", short, held_out)
        recalls[rate] = _scores(folder / f"rate-{rate:g}")[-1]["recall_at_1"]
    best, named = max(recalls, key=lambda rate: recalls[rate]), {f"{rate:g}": value for rate, value in recalls.items()}
    write_json(folder / RATES_FILE, {"seconds": settings.search_seconds, "recall_at_1": named, "best": best})
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
        before = 0 if upright else settings.upright_images
        staged = dataclasses.replace(config, steps=(images - before) // per_step, rotate=not upright)
        clock = Clock(folder, limit_s=settings.seconds)
        if clock.is_over:
            return
        options = {"resume": (run / "config.json").is_file(), "callback": clock}
        options["weights"] = folder / UPRIGHT / LAST_WEIGHTS if before else None
        stage = [one for one in recordings if not upright or one.name != OPPOSITE]
        with stop_on_signal() as stopped:
            result = sglpr_jax.train(staged, stage, out=run, stopped=lambda: stopped() or clock.is_over, **options)  # noqa: B023
        seen = before + result.steps * per_step
        print(f"{run}: {seen} images, {clock.seconds:.0f} s", file=sys.stderr, flush=True)
        if stopped():
            sys.exit(stopped.exit_status)
        _keep(folder, result.params, seen, clock.seconds, held_out)


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
    files = [sglpr_jax.embed(params, recording) for recording in held_out]
    recalls = [
        recall_at_1(file.descriptors, file.positions, file.times, distance_function(file.distance)) for file in files
    ]
    line = {"images": images, "seconds": round(seconds, 1), "recall_at_1": float(np.mean(recalls))}
    with (folder / SCORES_FILE).open("a") as file:
        print(json.dumps(line), file=file)
    print(f"{folder}: {line}", file=sys.stderr, flush=True)


def _scores(folder: Path) -> list[dict[str, float]]:
    path = folder / SCORES_FILE
    return [json.loads(line) for line in path.read_text().splitlines()] if path.is_file() else []
