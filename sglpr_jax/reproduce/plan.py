"""Prepares a reproduction: checks the inputs, finds the missing training runs and estimates the training time."""

import time
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import jax

from sglpr_jax.data.readers import open_recording, recording_names
from sglpr_jax.data.recording import Recording
from sglpr_jax.data.scan_stream import require_content
from sglpr_jax.methods.registry import handcrafted, method_with_weights
from sglpr_jax.reproduce.experiments import EXPERIMENTS, FULL
from sglpr_jax.reproduce.reproduction import Reproduction, content_of
from sglpr_jax.revisits import revisits
from sglpr_jax.training.batch_source import training_batches
from sglpr_jax.training.image_network import ImageNetwork
from sglpr_jax.training.step import train_step
from sglpr_jax.training.tuples import tuple_pool

TIMED_STEPS = 3


def check_inputs(reproduction: Reproduction, names: Sequence[str], nclt: Path | None = None) -> None:
    """Raise ValueError or FileNotFoundError if the named tables or figures lack an input."""
    if not names:
        raise ValueError(f"expected tables or figures, found none; choose from all, {', '.join(EXPERIMENTS)}")
    data, trained = reproduction.data, reproduction.trained
    recordings = recording_names(data)
    experiments = {name: EXPERIMENTS[name] for name in names}
    if not reproduction.seqs:
        raise ValueError(
            f"{data}: expected recordings named as in the paper, found {', '.join(recordings)}; choose yours with --seq"
        )
    variants_only = [name for name, experiment in experiments.items() if not experiment.beside_handcrafted]
    if not trained and (variants_only or not (reproduction.methods or reproduction.weights)):
        only = ", ".join(variants_only)
        found = f"{only}, which compares trained variants" if only else "no --weights and no --method"
        raise ValueError(f"with --no-train, expected tables 1 to 3 or figure 5 of other methods, found {found}")
    if trained and len(recordings) < 2:
        raise ValueError(
            f"{data}: expected two recordings or more, to train and test on, found {', '.join(recordings)}"
        )
    for seq in (*reproduction.seqs, *(recordings if trained else [])):
        if reproduction.recording(seq).positions is None:
            raise ValueError(f"{data}: sequence {seq} has no poses; training and scoring need them")
    if nclt is not None and any(experiment.across_sessions for experiment in experiments.values()):
        sessions = [open_recording(nclt, name) for name in recording_names(nclt)]  # the first is the database
        if len(sessions) < 2:
            raise ValueError(f"{nclt}: expected two sessions or more, found {', '.join(one.name for one in sessions)}")
        unknown = [session.name for session in sessions if session.positions is None]
        if unknown and "table3" in names:  # figure 8 has no scores
            raise ValueError(f"{nclt}: session {unknown[0]} has no poses; scoring needs them")
    for name in reproduction.weights:
        method_with_weights(name)  # raises an error if the weights are missing or damaged
    for name, experiment in experiments.items():
        if experiment.needs_labels and not reproduction.config_of(FULL).model.segments:
            raise ValueError(
                f"{name} is about semantics: expected a preset that trains a segmentation head, found "
                f"{reproduction.preset}"
            )
        reads_labels = any(reproduction.config_of(variant).model.categories_read for variant in experiment.variants)
        for seq in recordings if experiment.needs_labels else ():
            title = f"{name} is about semantics and"
            require_content(title, "labelled images", reproduction.recording(seq), every_label=reads_labels)
    if len(variants_only) < len(experiments):
        _check_methods(reproduction)


def _check_methods(reproduction: Reproduction) -> None:
    """Raise ValueError for an unknown method, or if a test recording lacks the points or labels that a method needs."""
    for name in reproduction.methods:
        handcrafted(name, None)  # raises an error if the name is unknown
    for flag, names in (("--method", reproduction.methods), ("--weights", reproduction.weights)):
        errors: dict[str, str] = {}
        for name in names:
            takes = content_of(name)
            try:
                for seq in reproduction.seqs:
                    require_content(name, takes, reproduction.recording(seq), every_label=True)
            except ValueError as error:
                errors[name] = str(error)
        if errors:
            usable = " ".join([flag, *(name for name in names if name not in errors)])
            raise ValueError("; ".join([*errors.values(), f"use {usable}"]))


class Plan(NamedTuple):
    """The training runs that the experiments need. A run (variant, recording) trains without this test recording."""

    runs: tuple[tuple[str, str], ...]
    missing: tuple[tuple[str, str], ...]
    """Runs that are not trained to the end."""
    steps: int
    without_revisits: tuple[str, ...] = ()
    """Test recordings without revisits, by the rule of top-1 F1max. They have no scores."""

    def text(self, seconds_per_step: float | None) -> str:
        """Describe the plan: missing runs by variant, recordings without scores, and the time to train."""
        trained = len(self.runs) - len(self.missing)
        lines = [f"{len(self.runs)} leave-one-out runs of {self.steps} steps, {trained} of them already trained"]
        for variant in dict.fromkeys(variant for variant, _ in self.missing):
            recordings = ", ".join(seq for missing_variant, seq in self.missing if missing_variant == variant)
            lines.append(f"  {variant}: to train for {recordings}")
        if self.without_revisits:
            lines.append(f"no revisits in {', '.join(self.without_revisits)}: no scores for them, and no means")
        if self.missing and seconds_per_step is not None:
            minutes = len(self.missing) * self.steps * seconds_per_step / 60
            lines.append(f"about {minutes:.0f} min of training ({seconds_per_step:.2g} s a step), plus compilation")
        return "\n".join(lines)


def make_plan(reproduction: Reproduction, names: Sequence[str]) -> Plan:
    """Return the plan for these experiments. Raises ValueError if a run in the folder has other settings."""
    experiments = [EXPERIMENTS[name] for name in names]
    runs = {}  # keys in order, without repetition
    for experiment in experiments:
        # Across sessions, one run of each variant suffices: none is trained on the sessions.
        seqs = reproduction.seqs[:1] if experiment.across_sessions else reproduction.seqs
        runs |= dict.fromkeys((variant, seq) for variant in experiment.variants for seq in seqs)
    missing = tuple(run for run in runs if not reproduction.is_trained(*run))
    without_revisits = ()
    if not all(experiment.across_sessions for experiment in experiments):  # otherwise only sessions are scored
        without_revisits = tuple(seq for seq in reproduction.seqs if not _has_revisits(reproduction.recording(seq)))
    return Plan(tuple(runs), missing, reproduction.config.steps, without_revisits)


def _has_revisits(recording: Recording) -> bool:
    """Return whether a recording has a revisit by the rule of top-1 F1max: within 3 m and 30 s older."""
    assert recording.positions is not None  # checked by `check_inputs`
    return bool(revisits(recording.positions, times=recording.times).any())


def time_a_step(reproduction: Reproduction, variant: str, seq: str) -> float:
    """Measure the duration of a training step of a run in seconds, on its first batches, without compilation."""
    config, recordings = reproduction.config_of(variant), reproduction.recordings_but(seq)
    network, pool = ImageNetwork(config), tuple_pool(recordings, config.sampling)
    batches = training_batches(recordings, pool, config)
    state, start = network.new_state(), 0.0
    for step in range(1 + TIMED_STEPS):
        if step == 1:  # step 0 compiles and is not timed
            start = time.perf_counter()
        state, metrics = train_step(state, batches.batch(step), network=network)
        jax.block_until_ready(metrics)
    return (time.perf_counter() - start) / TIMED_STEPS
