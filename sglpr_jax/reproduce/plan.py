"""Before a reproduction trains: checks of its inputs, the missing runs, and the estimated training time."""

import time
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import jax

from sglpr_jax.data.readers import recording_names
from sglpr_jax.data.recording import Recording
from sglpr_jax.evaluation import figures
from sglpr_jax.methods.handcrafted import HANDCRAFTED
from sglpr_jax.methods.registry import method_with_weights
from sglpr_jax.reproduce.experiments import EXPERIMENTS, VARIANTS
from sglpr_jax.reproduce.reproduction import Reproduction, content_of
from sglpr_jax.revisits import revisits
from sglpr_jax.training.batch_source import training_batches
from sglpr_jax.training.batches import tuple_pool
from sglpr_jax.training.image_network import ImageNetwork
from sglpr_jax.training.step import train_step

TIMED_STEPS = 3


def check(reproduction: Reproduction, names: Sequence[str], nclt: Path | None = None) -> None:
    """Check recordings, methods, weights and sessions for the chosen tables and figures.

    Raises ValueError, FileNotFoundError or ImportError (matplotlib) that names what is unknown or missing.
    """
    if not names:
        raise ValueError(f"expected tables or figures, found none; choose from all, {', '.join(EXPERIMENTS)}")
    data, trained = reproduction.data, reproduction.trained
    recordings, experiments = recording_names(data), {name: EXPERIMENTS[name] for name in names}
    if not reproduction.seqs:
        raise ValueError(
            f"{data}: expected recordings named as in the paper, found {', '.join(recordings)}; choose yours with --seq"
        )
    if any(experiment.kind == "figure" for experiment in experiments.values()) and not figures.can_draw():
        raise ImportError("figures need matplotlib: pip install 'sglpr-jax[viz]'")
    alone = [name for name, experiment in experiments.items() if not experiment.beside_handcrafted]
    if not trained and (alone or not (reproduction.methods or reproduction.weights)):
        what = f"{', '.join(alone)}, which compares trained variants" if alone else "no --weights and no --method"
        raise ValueError(f"with --no-train, expected tables 1 to 3 or figure 5 of other methods, found {what}")
    if trained and len(recordings) < 2:
        raise ValueError(
            f"{data}: expected two recordings or more, to train and test on, found {', '.join(recordings)}"
        )
    for seq in (*reproduction.seqs, *(recordings if trained else [])):
        if reproduction.recording(seq).positions is None:
            raise ValueError(f"{data}: sequence {seq} has no poses; training and scoring need them")
    if nclt is not None and any(experiment.across_sessions for experiment in experiments.values()):
        sessions = recording_names(nclt)  # the first is the database, the others are queries
        if len(sessions) < 2:
            raise ValueError(f"{nclt}: expected two sessions or more, found {', '.join(sessions)}")
    for name in reproduction.weights:
        method_with_weights(name)  # raises an error if the weights are missing or damaged
    for name in (name for name, experiment in experiments.items() if experiment.needs_labels):
        for seq in recordings:
            if not reproduction.recording(seq).has_labels:
                raise ValueError(f"{name} is about semantics: expected labels in sequence {seq} of {data}, found none")
    if len(alone) < len(experiments):
        _check_methods(reproduction)


def _check_methods(reproduction: Reproduction) -> None:
    for name in reproduction.methods:
        if name not in HANDCRAFTED:
            raise ValueError(f"expected a handcrafted method, found {name!r}; available: {', '.join(HANDCRAFTED)}")
    for name in (*reproduction.methods, *reproduction.weights):
        needs = content_of(name)
        for seq in reproduction.seqs:
            recording = reproduction.recording(seq)
            if needs != "images" and recording.has_images:
                raise ValueError(f"{name} needs points, found images in sequence {seq}; leave it out")
            if needs == "labelled points" and not recording.has_labels:
                raise ValueError(f"{name} needs labels, found none in sequence {seq}; leave it out")


class Plan(NamedTuple):
    """The runs that the experiments need, and those that are not trained yet, as (variant, recording)."""

    runs: tuple[tuple[str, str], ...]
    missing: tuple[tuple[str, str], ...]
    steps: int
    without_revisits: tuple[str, ...] = ()
    """Test recordings without revisits, by the rule of top-1 F1max. They have no scores."""

    def text(self, seconds_per_step: float | None) -> str:
        """Describe the plan."""
        done = len(self.runs) - len(self.missing)
        lines = [f"{len(self.runs)} leave-one-out runs of {self.steps} steps, {done} of them already trained"]
        for variant in dict.fromkeys(variant for variant, _ in self.missing):
            recordings = ", ".join(seq for name, seq in self.missing if name == variant)
            lines.append(f"  {VARIANTS[variant].label}: to train for {recordings}")
        if self.without_revisits:
            lines.append(f"no revisits in {', '.join(self.without_revisits)}: no scores for them, and no means")
        if self.missing and seconds_per_step is not None:
            minutes = len(self.missing) * self.steps * seconds_per_step / 60
            lines.append(f"about {minutes:.0f} min of training ({seconds_per_step:.2g} s a step), plus compilation")
        return "\n".join(lines)


def make_plan(reproduction: Reproduction, names: Sequence[str]) -> Plan:
    """Return the plan for these experiments.

    Experiments across sessions need only one run of each variant. Raises ValueError if a run has other settings.
    """
    runs, scored = {}, {}
    for experiment in (EXPERIMENTS[name] for name in names):
        seqs = reproduction.seqs[:1] if experiment.across_sessions else reproduction.seqs
        scored |= {} if experiment.across_sessions else dict.fromkeys(seqs)
        runs |= dict.fromkeys((variant, seq) for variant in experiment.variants for seq in seqs)
    missing = tuple(run for run in runs if not reproduction.is_trained(*run))
    straight = [seq for seq in scored if not _has_revisits(reproduction.recording(seq))]
    return Plan(tuple(runs), missing, reproduction.config.steps, tuple(straight))


def _has_revisits(recording: Recording) -> bool:
    assert recording.positions is not None  # checked by `check`
    return bool(revisits(recording.positions, times=recording.times).any())


def time_a_step(reproduction: Reproduction, variant: str, seq: str) -> float:
    """Measure the duration of a training step in seconds, on the first batches of the run, without compilation."""
    config, recordings = reproduction.config_of(variant), reproduction.recordings_but(seq)
    network, batches = ImageNetwork(config), training_batches(recordings, tuple_pool(recordings, config), config)
    state, start = network.new_state(), 0.0
    for step in range(1 + TIMED_STEPS):
        start = time.perf_counter() if step == 1 else start
        state, metrics = train_step(state, batches.batch(step), network=network)
        jax.block_until_ready(metrics)
    return (time.perf_counter() - start) / TIMED_STEPS
