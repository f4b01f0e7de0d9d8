"""Training of the networks of other publications (`methods/learned/`), and the search of their learning rate."""

import dataclasses
import functools
import math
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jax.sharding import AxisType, Mesh
from jaxtyping import Array, Float, Float32, Int, Shaped

from sglpr_jax.data.fingerprint import fingerprint
from sglpr_jax.fields import CountOrZero, NotNegative, Positive, check_fields
from sglpr_jax.files import read_json, write_json
from sglpr_jax.methods.learned.method import LearnedMethod, Tuples, Variables
from sglpr_jax.methods.learned.trained import describe_inputs, learned_distance, random_variables, save_variables
from sglpr_jax.models.weights_file import LAST_WEIGHTS
from sglpr_jax.progress import Progress, no_progress
from sglpr_jax.training.batch_source import TupleBatches
from sglpr_jax.training.callbacks import Callback
from sglpr_jax.training.devices import AXIS
from sglpr_jax.training.peer_inputs import TrainingInputs
from sglpr_jax.training.run_folder import CONFIG_FILE, lock_run
from sglpr_jax.training.step import Gradient, TrainState
from sglpr_jax.training.trainer import Schedule, Trained, Trainer
from sglpr_jax.training.tuples import TuplePool, positions_of, tuple_pool
from sglpr_jax.training.validation import RECALL, recall_at_1

RATES_FILE = "rates.json"
LIMITS = ("settings.seconds", "settings.images")
"""Settings that may differ when a run is resumed."""
FIRST_SNAPSHOT = 1000
"""Number of images at the first snapshot of the weights. Each further snapshot has twice as many."""
START_PLACES = 100
"""Number of random places from which `LearnedMethod.start` sets weights."""
LOG_EVERY = 10
"""Number of steps between two lines of the metrics."""
SAVE_EVERY_S, REPORT_EVERY_S = 60.0, 30.0
"""Training time between two saved states, and between two lines of progress, in seconds."""
PLACES_IN_MEMORY = 256
"""Number of places whose inputs are in memory at a time."""


@dataclasses.dataclass(frozen=True)
class RunSettings:
    """Settings of a run. The recipe of its method has the others."""

    learning_rate: Positive
    seed: CountOrZero = 0
    seconds: NotNegative = 3600.0
    """Training time in seconds. Scores and the compilation of the step do not count."""
    images: CountOrZero = 0
    """Number of images after which the training stops; 0: no limit."""

    def __post_init__(self):
        check_fields(self)


@dataclasses.dataclass(frozen=True, eq=False)
class HeldOutScore:
    """Score of a method's weights on held-out recordings, which must have revisits (`require_revisits`)."""

    method: LearnedMethod
    held_out: TrainingInputs

    def __call__(self, variables: Variables) -> dict[str, float]:
        """Return `recall_at_1 NAME` for each recording, and the mean `recall_at_1`, which selects the best weights."""
        distance, recalls = learned_distance(self.method, variables), {}
        for recording, inputs in zip(self.held_out.recordings, self.held_out.inputs, strict=True):
            descriptors, positions = describe_inputs(self.method, variables, inputs), positions_of(recording)
            recalls[f"{RECALL} {recording.name}"] = recall_at_1(descriptors, positions, recording.times, distance)
        return {RECALL: float(np.mean(list(recalls.values()))), **recalls}


class PeerBatch(NamedTuple):
    """Training tuples of one step: t tuples of k places, which are b = t k places in all."""

    inputs: Shaped[Any, "b ..."]
    """Input of each place, tuple after tuple."""
    anchor_distance_m: Float[Any, "t k"]
    """Distance of each place from the anchor of its tuple, in metres. Infinite between worlds (`Recording.world`)."""


@dataclasses.dataclass(frozen=True)
class PeerNetwork:
    """A `PlaceNetwork` (`training.step`) with the network and the recipe of a learned method.

    The learning rate is in the state of the optimiser, so that one compiled step serves every rate.
    """

    method: LearnedMethod
    seed: int = 0

    @property
    def images(self) -> int:
        sampling = self.method.recipe.sampling
        return self.method.recipe.tuples * (1 + sampling.positives + sampling.negatives)

    @property
    def optimizer(self) -> optax.GradientTransformation:
        """Adam. The weight decay is added to the gradient, as in PyTorch."""
        return self._adam(0.0)

    def new_state(self, learning_rate: float = 0.0) -> TrainState:
        """Return the state before the first step, with random weights."""
        variables = dict(random_variables(self.method, seed=self.seed))
        params = variables.pop("params")
        return TrainState(jnp.int32(0), params, self._adam(learning_rate).init(params), variables)

    def gradient(self, state: TrainState, batch: PeerBatch, key: Array) -> Gradient:
        """Return the gradient of the loss of the rotated inputs, and the loss."""
        inputs = self.method.rotate_inputs(key, batch.inputs)

        def loss_of(params):
            variables = {"params": params, **state.statistics}
            outputs, statistics = self.method.network.apply(variables, inputs, train=True, mutable=[*state.statistics])
            descriptors = outputs.reshape(*batch.anchor_distance_m.shape, -1)
            tuples = Tuples(descriptors, batch.anchor_distance_m, self.method.recipe.sampling.positives)
            return self.method.loss({"params": params, **statistics}, tuples), statistics

        (loss, statistics), gradient = jax.value_and_grad(loss_of, has_aux=True)(state.params)
        return Gradient(gradient, {**state.statistics, **statistics}, {"loss": loss})

    def _adam(self, learning_rate: float) -> optax.GradientTransformation:
        decay = optax.add_decayed_weights(self.method.recipe.weight_decay)
        scale = optax.inject_hyperparams(optax.scale_by_learning_rate)(learning_rate=learning_rate)
        return optax.chain(decay, optax.scale_by_adam(), scale)


def variables_of(state: TrainState) -> Variables:
    """Return the parameters and statistics of a state as variables of a learned method."""
    return {"params": state.params, **state.statistics}


def train_learned(
    method: LearnedMethod,
    data: TrainingInputs,
    settings: RunSettings,
    out: Path,
    *,
    score: HeldOutScore | None = None,
    resume: bool = False,
    stopped: Callable[[], bool] = lambda: False,
    report: Callable[[str], None] = lambda line: None,
    progress: Progress = no_progress,
) -> Trained:
    """Train a method until its time or its number of images is reached, whichever is first.

    The folder `out` gets the settings, the measurements (`metrics.jsonl`), snapshots of the weights (`weights-1000`,
    `weights-2000`, `weights-4000`, ...), the last weights (`weights`) and checkpoints for resuming. A resumed run has
    the batches and the weights of an uninterrupted one.

    Arguments:
      method: Method to train, from random weights.
      data: Training recordings and their inputs.
      score: Scores each snapshot, for `scores.jsonl`.
      resume: Continue the run in the folder.
      stopped: Asked after every step. If it returns True, the state is saved and the training stops.
      report: Receives a line about the progress every 30 s.
      progress: Displays the training time.

    Raises:
      FloatingPointError: The loss is not finite. The message names the step.
      ValueError: The recordings give no tuples, or the run to resume has other settings.
      OSError: The folder cannot be written, has a run already, or has none to resume.
    """
    network, settings_json = PeerNetwork(method, settings.seed), dataclasses.asdict(settings)

    def save_weights(run: Trained, name: str) -> None:
        about = {"images": run.images, "seconds": round(run.seconds, 3), "settings": settings_json}
        save_variables(out / name, method, variables_of(run.state), about)

    recipe = dataclasses.asdict(method.recipe)
    del recipe["learning_rates"]  # the settings have the learning rate of this run
    recordings = [{"name": recording.name, "scans": len(recording)} for recording in data.recordings]
    config = {"method": method.name, "settings": settings_json, "recipe": recipe, "recordings": recordings}
    pool = tuple_pool(data.recordings, method.recipe.sampling)  # may raise, before the folder becomes a run
    lock = lock_run(out, config, seed=settings.seed, resume=resume, limits=LIMITS)
    with lock, progress(f"train {method.name}", math.ceil(settings.seconds)) as show:
        trainer = Trainer(
            network,
            _peer_batches(network, data, pool, out),
            out,
            Schedule(
                LOG_EVERY,
                first_snapshot=FIRST_SNAPSHOT,
                save_every_s=SAVE_EVERY_S,
                images=settings.images or Schedule.images,
                seconds=settings.seconds,
                costs=True,
            ),
            mesh=Mesh(np.array(jax.devices()[:1]), (AXIS,), axis_types=(AxisType.Auto,)),
            first_state=functools.partial(_first_state, network, data, pool, settings.learning_rate),
            score=lambda state: {} if score is None else score(variables_of(state)),
            save_snapshot=lambda run, images: save_weights(run, f"{LAST_WEIGHTS}-{images}"),
            resume=resume,
            callback=_ReportLines(report, show),
        )
        run = trainer.train(stopped)
        save_weights(run, LAST_WEIGHTS)
        return run


class _ReportLines(Callback):
    """Reports the loss every 30 s of training and, with held-out recordings, the loss and the scores at each snapshot.
    Shows the training time."""

    def __init__(self, report: Callable[[str], None], show: Callable[[int], None]):
        self._report, self._show, self._last_report_s, self._line = report, show, 0.0, ""

    def on_step(self, step: int, values: Mapping[str, float]) -> None:
        seconds = values["seconds"]
        self._show(int(seconds))
        self._line = f"step {step}: {values['images']:.0f} images, {seconds:.0f} s, loss {values['loss']:.4g}"
        if seconds > self._last_report_s + REPORT_EVERY_S:
            self._last_report_s = seconds
            self._report(self._line)

    def on_score(self, step: int, scores: Mapping[str, float]) -> None:
        recalls = (f"{name} {value:.3f}" for name, value in scores.items() if name.startswith(RECALL))
        self._report(", ".join((self._line, *recalls)))


def _first_state(network: PeerNetwork, data: TrainingInputs, pool: TuplePool, learning_rate: float) -> TrainState:
    """Return random weights, changed by the method's `start`, which receives the inputs of random places."""
    state = network.new_state(learning_rate)
    if network.method.start is None:
        return state
    places = np.random.default_rng(network.seed).permutation(len(pool))[:START_PLACES]
    variables = network.method.start(variables_of(state), data.at_places(pool, places))
    return dataclasses.replace(state, params=variables["params"])


def _peer_batches(network: PeerNetwork, data: TrainingInputs, pool: TuplePool, out: Path) -> TupleBatches:
    """Return the batches of a run. Its folder `out` stores the descriptors that select hard negatives."""

    def read(places: Int[np.ndarray, "t k"]) -> PeerBatch:
        return PeerBatch(data.at_places(pool, places.reshape(-1)), pool.distances_from_anchors(places))

    def describe(state: TrainState, places: Int[np.ndarray, " n"]) -> Float32[np.ndarray, "n d"]:
        variables = variables_of(state)
        blocks = np.array_split(places, math.ceil(len(places) / PLACES_IN_MEMORY))
        descriptors = [describe_inputs(network.method, variables, data.at_places(pool, block)) for block in blocks]
        return np.concatenate(descriptors)

    tuples = network.method.recipe.tuples
    return TupleBatches(data.recordings, pool, read, seed=network.seed, tuples=tuples, describe=describe, run=out)


class Stopped(Exception):
    """The search was asked to stop. Its trainings can be resumed."""


def best_rate(
    method: LearnedMethod,
    data: TrainingInputs,
    score: HeldOutScore,
    out: Path,
    *,
    seconds: float = 300.0,
    seed: int = 0,
    report: Callable[[str], None] = lambda line: None,
    **options: Any,
) -> float:
    """Train with each of the three learning rates of the method and return the one with the highest Recall@1.

    The folder `out` gets the trainings, of `seconds` each, and `rates.json` with all scores. Finished trainings are not
    repeated; they are scored again after more steps or on other held-out recordings. A rate whose loss is not finite
    has no score. If scores are equal, the smaller rate is returned. `options` are those of `train_learned`. Raises
    FloatingPointError if no loss is finite, and `Stopped` after a stop.
    """
    recalls: dict[float, float | None] = {}
    for rate in method.recipe.learning_rates:
        settings, folder = RunSettings(rate, seed=seed, seconds=seconds), out / f"rate-{rate:g}"
        resume, score_file = (folder / CONFIG_FILE).is_file(), folder / "score.json"
        try:
            run = train_learned(method, data, settings, folder, resume=resume, report=report, **options)
            if run.seconds < seconds:
                raise Stopped
            held_out = [[recording.name, fingerprint(recording)] for recording in score.held_out.recordings]
            scored = {"step": int(run.state.step), "held_out": held_out}
            scores = read_json(score_file) if score_file.is_file() else {}
            if scores.get("scored") != scored:  # other steps or recordings, or none yet
                scores = {"scored": scored, **score(variables_of(run.state))}
                write_json(score_file, scores)
            recalls[rate] = float(scores[RECALL])
        except FloatingPointError:
            recalls[rate] = None
        report(f"learning rate {rate:g}: {RECALL} {recalls[rate]}")
    finite = {rate: recall for rate, recall in recalls.items() if recall is not None}
    if not finite:
        raise FloatingPointError(f"{out}: the loss of {method.name} is not finite with any of its learning rates")
    best = max(finite, key=lambda rate: finite[rate])
    about = {"method": method.name, "seconds": seconds, "seed": seed}
    recall_of_rate = {f"{rate:g}": recall for rate, recall in recalls.items()}
    write_json(out / RATES_FILE, {**about, RECALL: recall_of_rate, "best": best})
    return best
