"""A whole training in one call, from recordings to weights. `bin/train` adds only the final test."""

import contextlib
import dataclasses
import functools
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np
from jaxtyping import Float32, Int

from sglpr_jax.data.packed import packed
from sglpr_jax.data.recording import Recording
from sglpr_jax.files import warn
from sglpr_jax.models.sglpr import init
from sglpr_jax.models.weights import Params, adopt, different_fields, graft, own_hash, weights_hash, without_whitening
from sglpr_jax.models.weights_file import LAST_WEIGHTS, load, save
from sglpr_jax.training.batch_source import TupleBatches, training_batches
from sglpr_jax.training.callbacks import Callback
from sglpr_jax.training.config import TrainConfig, without_untrained_head
from sglpr_jax.training.devices import data_mesh, host_copy, is_first_host, on_all_hosts
from sglpr_jax.training.image_network import ImageNetwork
from sglpr_jax.training.metrics_log import Throughput, read_metrics, throughput
from sglpr_jax.training.run_folder import CHECKPOINTS, checkpoint_steps, lock_run
from sglpr_jax.training.step import TrainState
from sglpr_jax.training.trainer import METRICS_FILE, Schedule, Trained, Trainer
from sglpr_jax.training.tuples import split_recordings, tuple_pool
from sglpr_jax.training.validation import describe_places, training_recall, validation_score

LIMITS = ("config.steps",)
"""Settings that may differ when a run is resumed."""

ScoreFn = Callable[[Params], dict[str, float]]
"""Scores weights."""


class PackingStopped(Exception):
    """A run was asked to stop while it packed its recordings. Complete packs are kept."""


@dataclasses.dataclass(frozen=True, eq=False, repr=False)
class TrainResult:
    """Result of a training run. Printing it shows the finished steps, the folder of the weights and the speed.

    `params` are the last weights, which are also stored in `folder`/weights. A run that was too short has no
    `throughput`.
    """

    params: Params
    folder: Path
    steps: int
    config: TrainConfig
    throughput: Throughput | None

    @property
    def finished(self) -> bool:
        """Whether all steps are done. A run that was stopped earlier can continue with `resume`."""
        return self.steps == self.config.steps

    def __str__(self) -> str:
        lines = [f"{self.folder}: {self.steps} of {self.config.steps} steps, weights in {self.folder / LAST_WEIGHTS}"]
        if self.throughput is not None:
            steps, waiting = self.throughput.steps_per_second, self.throughput.data_wait
            speed = f"{steps:.3g} steps/s, {steps * self.config.tuples:.3g} tuples/s"
            lines.append(f"{speed}, {waiting:.1%} of the time waiting for data")
        return "\n".join(lines)

    __repr__ = __str__


def train(
    config: TrainConfig,
    recordings: Sequence[Recording],
    *,
    out: Path | str,
    test: Recording | None = None,
    also: Sequence[Recording] = (),
    weights: Params | Path | str | None = None,
    resume: bool = False,
    cache: Path | None = None,
    callback: Callback | None = None,
    stopped: Callable[[], bool] = lambda: False,
    settings: Mapping[str, Any] | None = None,
) -> TrainResult:
    """Train a model on recordings. The folder `out` stores the run, which can be resumed from there.

    Args:
        config: Model, loss, optimiser, number of steps and all other settings, for example `preset("sglpr")`.
        recordings: Training recordings. They need positions, and labels if the place head reads them. Without labels, a
            segmentation head keeps its initial weights.
        out: Folder of the run: settings, metrics, checkpoints and the final weights.
        test: Recording of the later test. It is not read; the function only checks that it is not trained on.
        also: Recordings of a second dataset, which provide `config.also_tuples` tuples of each step.
        weights: Initial weights: a name, a folder or `Params`. None: random weights. A resumed run needs the same.
        resume: Continue from the newest checkpoint of the run in `out`.
        cache: Folder in which each recording is packed on first use, for faster reading.
        callback: Follows the run: a `ProgressBar`, `EventFiles` or your own.
        stopped: Called after every step. If it returns true, the run saves its state and stops. While recordings are
            packed, a stop raises `PackingStopped`.
        settings: Entries of config.json beside `config`. They must be equal in a resumed run. None: the names of the
            recordings, and the weights.

    Returns:
        The weights and a summary of the run.

    Raises:
        ValueError: The recordings or the weights do not fit `config`, or the run to resume has other settings or more
            steps done.
        FileExistsError: The folder already has a run.
        FileNotFoundError: The folder has no run to resume.
        FloatingPointError: The loss is not finite.
        OSError: A file cannot be read or written.

    Example:
      recordings = [open_recording("KITTI", name) for name in ("00", "05")]
      result = train(preset("sglpr"), recordings, out="runs/mine")
      print(result)
    """
    folder = Path(out)
    config = with_teacher(without_untrained_head(config))
    _require_usable(config, recordings, also, test)
    if config.loss.segmentation_alone:
        config = with_kept_descriptors(config, weights)
    if settings is None:
        settings = {
            "recordings": [recording.name for recording in recordings],
            "also": [recording.name for recording in also],
            "test": None if test is None else test.name,
            "weights": _identity(weights),
        }
    with contextlib.ExitStack() as exit_stack:
        host_callback = callback if callback and is_first_host() else Callback()
        exit_stack.enter_context(contextlib.closing(host_callback))
        recordings, also = on_all_hosts(
            lambda: [_packed(group, cache, host_callback, stopped) for group in (recordings, also)]
        )
        source, score = _batches_and_score(recordings, also, config, folder)
        last_step = max(checkpoint_steps(folder / CHECKPOINTS), default=0) if resume else 0
        start_from = None if last_step else _initial_weights(weights, config)
        if config.steps < last_step:
            expected = f"at least the {last_step} steps that are already done"
            raise ValueError(f"{folder}: expected {expected}, found {config.steps}")
        lock = lock_run(folder, run_settings(config, settings), seed=config.seed, resume=resume, limits=LIMITS)
        on_all_hosts(lambda: is_first_host() and exit_stack.enter_context(lock))
        if config.model.segments and not _have_labels((*recordings, *also)):
            warn(
                f"expected labels for the segmentation head, found none in {len(recordings) + len(also)} recording(s): "
                "the head keeps its initial weights; model.categories 0 omits it"
            )
        options = {"start_from": start_from, "resume": resume, "callback": host_callback, "stopped": stopped}
        state = run_network(config, source, folder, score=score, **options).state
        steps, params, speed = int(state.step), host_copy(state.params), None
        if is_first_host():
            save(params, folder / LAST_WEIGHTS)
            speed = throughput(read_metrics(folder / METRICS_FILE))
        host_callback.on_end(steps)
    return TrainResult(params, folder, steps, config, speed)


def run_settings(config: TrainConfig, settings: Mapping[str, Any]) -> dict[str, Any]:
    """Return the content of config.json in the folder of a run."""
    return {**settings, "config": dataclasses.asdict(config)}


def run_network(
    config: TrainConfig,
    source: TupleBatches,
    folder: Path,
    *,
    score: ScoreFn,
    start_from: Params | None = None,
    resume: bool = False,
    callback: Callback | None = None,
    stopped: Callable[[], bool] = lambda: False,
) -> Trained:
    """Train the network of a configuration with the batches of `source`. The other arguments are those of `Trainer`.

    `data_mesh` raises ValueError if the devices cannot share a step.
    """
    network = ImageNetwork(config)
    trainer = Trainer(
        network,
        source,
        folder,
        Schedule(config.log_every, config.score_every, steps=config.steps),
        mesh=data_mesh(config),
        first_state=functools.partial(network.new_state, start_from),
        score=lambda state: score(state.params),
        resume=resume,
        callback=callback,
    )
    return trainer.train(stopped)


def _batches_and_score(
    recordings: Sequence[Recording], also: Sequence[Recording], config: TrainConfig, folder: Path
) -> tuple[TupleBatches, ScoreFn]:
    """Return batches of the training places, and a score, on held-out places or, without them, on training places."""
    splits = split_recordings(recordings, config)
    pool = tuple_pool(recordings, config.sampling, frames=[training for training, _ in splits])
    if config.needs_negatives and not (also and config.also_triplets) and not pool.has_negatives:
        raise ValueError(
            f"expected places farther apart than sampling.negative_m, {config.sampling.negative_m} m, as negatives, "
            "found none; in a small place, reduce it"
        )

    def describe(state: TrainState, places: Int[np.ndarray, "n"]) -> Float32[np.ndarray, "n d"]:
        return describe_places(state.params, recordings, pool, places, np.zeros(len(places)), config)

    if config.validation.share:
        score = validation_score(recordings, [validation for _, validation in splits], config)
    else:
        score = training_recall(recordings, pool, config)
    return training_batches(recordings, pool, config, also=also, describe=describe, run=folder), score


def _require_usable(
    config: TrainConfig, recordings: Sequence[Recording], also: Sequence[Recording], test: Recording | None
) -> None:
    """Raise ValueError if the recordings do not fit the configuration. `also` are those of a second dataset."""
    if not recordings:
        raise ValueError("expected recordings to train on, found none")
    hosts = jax.process_count()
    if hosts > 1 and (also or config.sampling.mining != "none"):
        raise ValueError(f"mined negatives and a second dataset work on one host only, found {hosts} hosts")
    _require_usable_also(config, recordings, also)
    if test is not None and test.name in {recording.name for recording in recordings}:
        raise ValueError(f"expected recordings to train on other than the one tested, found {test.name} in both")
    if config.loss.segmentation_alone and not _have_labels((*recordings, *also)):
        raise ValueError(
            "loss.segmentation_alone trains on labels alone: expected labels beside some scans, "
            f"found none in {len(recordings) + len(also)} recording(s)"
        )
    if not config.model.categories_read:
        return
    for recording in (*recordings, *also, *([] if test is None else [test])):
        labelled = sum(recording.labelled)
        if labelled < len(recording):
            raise ValueError(
                f"model.head.input reads labels: expected labels beside every scan of sequence {recording.name}, "
                f"found {labelled} of {len(recording)}"
            )


def _require_usable_also(config: TrainConfig, recordings: Sequence[Recording], also: Sequence[Recording]) -> None:
    """Raise ValueError if the recordings of a second dataset are not used, or if their negatives could be positives."""
    if bool(also) != bool(config.also_tuples):
        raise ValueError(
            "also_tuples is the number of tuples per step from the second dataset: expected both or neither, "
            f"found {len(also)} of its recordings and {config.also_tuples} tuples"
        )
    is_segmented = config.model.segments and _have_labels(also)
    if also and not (is_segmented or config.also_triplets or config.loss.teacher):
        raise ValueError(
            "the second dataset has no effect: expected labels in --also and a segmentation head, or --also-triplets "
            "True, found neither"
        )
    names = {recording.world: recording.name for recording in recordings if recording.world}
    shared = next((recording for recording in also if recording.world in names), None)
    if shared is not None and config.also_triplets and config.share_negatives:
        raise ValueError(
            "share_negatives makes the places of --also negatives of --data: expected no common world, found one of "
            f"{names[shared.world]} in --data and {shared.name} in --also; add the second dataset to --data instead"
        )


def _have_labels(recordings: Sequence[Recording]) -> bool:
    """Return whether any scan or image of the recordings has labels."""
    return any(recording.has_labels for recording in recordings)


def _identity(weights: Params | Path | str | None) -> str | None:
    """Return a text that identifies initial weights: their hash, their name or the whole path of their folder."""
    if weights is None:
        return None
    if isinstance(weights, Params):
        return own_hash(weights)
    return str(Path(weights).resolve() if Path(weights).exists() else weights)


def with_teacher(config: TrainConfig) -> TrainConfig:
    """Return the configuration of a model that states whose descriptors it learns, if there is a teacher.

    Raises ValueError if the teacher does not describe the images of the model by as many numbers.
    """
    name, model = config.loss.teacher, config.model
    if not name:
        return dataclasses.replace(config, model=dataclasses.replace(model, descriptors_of=""))
    teacher = load(name)
    for part, expected, found in (
        ("grid", model.grid, teacher.config.grid),
        ("image", model.image, teacher.config.image),
        ("head.descriptor_size", model.head.descriptor_size, teacher.config.head.descriptor_size),
    ):
        if expected != found:
            raise ValueError(
                f"loss.teacher {name}: expected the {part} of the trained model, {expected}, found {found}"
            )
    return dataclasses.replace(config, model=dataclasses.replace(model, descriptors_of=weights_hash(teacher)))


def with_kept_descriptors(config: TrainConfig, weights: Params | Path | str | None) -> TrainConfig:
    """Return the configuration of a model that keeps the descriptors of its initial weights (`segmentation_alone`).

    Raises ValueError without weights, or if the model would compute other descriptors with them.
    """
    expected = "loss.segmentation_alone trains no descriptors: expected"
    if weights is None:
        raise ValueError(f"{expected} weights to begin with, found none")
    given = (weights if isinstance(weights, Params) else load(weights)).config
    model = dataclasses.replace(config.model, descriptors_of=given.descriptors_of)
    same_head = dataclasses.replace(given, categories=model.categories, detail=model.detail)
    for name, (value, found) in different_fields(same_head, model).items():
        if name != "backbone.drop_path":  # acts in training only
            raise ValueError(f"{expected} model.{name} {value}, as in the weights, found {found}")
    return dataclasses.replace(config, model=model)


def _packed(
    recordings: Sequence[Recording], cache: Path | None, callback: Callback, stopped: Callable[[], bool]
) -> Sequence[Recording]:
    """Return the recordings, each read from one file in the folder `cache`. Missing files are written first."""
    if cache is None:
        return recordings

    def report(recording: Recording, done: int) -> None:
        callback.on_pack(recording.name, done, len(recording))
        if stopped():
            raise PackingStopped(f"stopped while packing {recording.name}")

    return [packed(recording, cache, on_progress=functools.partial(report, recording)) for recording in recordings]


def _initial_weights(weights: Params | Path | str | None, config: TrainConfig) -> Params:
    """Return the weights with random values for missing ones, and with a whitening layer only if the model has one.

    Without weights, the layers that a teacher has in the same form begin with its weights.
    """
    random = init(jax.random.key(config.seed), config=config.model)
    if weights is None:
        return adopt(load(config.loss.teacher), random) if config.loss.teacher else random
    params = weights if isinstance(weights, Params) else load(weights)
    params = params if config.model.head.whiten else without_whitening(params)
    return graft(params, random)
