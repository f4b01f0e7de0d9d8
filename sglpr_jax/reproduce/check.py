"""Checks of a reproduction before any training."""

from collections.abc import Sequence
from pathlib import Path

from sglpr_jax.data.readers import recording_names
from sglpr_jax.evaluation import figures
from sglpr_jax.methods.handcrafted import HANDCRAFTED
from sglpr_jax.methods.registry import method_with_weights
from sglpr_jax.reproduce.compared import content_of
from sglpr_jax.reproduce.experiments import EXPERIMENTS
from sglpr_jax.reproduce.runs import Runs


def check(
    runs: Runs,
    names: Sequence[str],
    seqs: Sequence[str],
    methods: Sequence[str],
    nclt: Path | None = None,
    *,
    weights: Sequence[str] = (),
    trained: bool = True,
) -> None:
    """Check recordings, methods, weights and sessions for the chosen tables and figures.

    Raises:
      ValueError: A method is unknown, or poses, points or labels are missing. Also if there is no second recording to
        train on, or no second session in `nclt`. Also if nothing is trained, but an experiment needs it.
      FileNotFoundError: `nclt` has no sessions, or weights are missing.
      ImportError: Figures are chosen, but matplotlib is not installed.
    """
    if not names:
        raise ValueError(f"expected tables or figures, found none; choose from all, {', '.join(EXPERIMENTS)}")
    if not seqs:
        found = ", ".join(recording_names(runs.data))
        raise ValueError(
            f"{runs.data}: expected recordings named as in the paper, found {found}; choose yours with --seq"
        )
    if any(EXPERIMENTS[name].kind == "figure" for name in names) and not figures.can_draw():
        raise ImportError("figures need matplotlib: pip install 'sglpr-jax[viz]'")
    alone = [name for name in names if not EXPERIMENTS[name].beside_handcrafted]
    if not trained and (alone or not (methods or weights)):
        what = f"{', '.join(alone)}, which compares trained variants" if alone else "no --weights and no --method"
        raise ValueError(f"with --no-train, expected tables 1 to 3 or figure 5 of other methods, found {what}")
    _check_recordings(runs, seqs, trained=trained)
    if nclt is not None and any(EXPERIMENTS[name].across_sessions for name in names):
        _check_sessions(nclt)
    for name in weights:
        method_with_weights(name)  # raises an error if the weights are missing or damaged
    for name in names:
        _check_labels(runs, name)
        if EXPERIMENTS[name].beside_handcrafted:
            _check_methods(runs, seqs, methods, weights)


def _check_recordings(runs: Runs, seqs: Sequence[str], *, trained: bool) -> None:
    recordings = recording_names(runs.data) if trained else []
    if trained and len(recordings) < 2:
        raise ValueError(
            f"{runs.data}: expected two recordings or more, to train and test on, found {', '.join(recordings)}"
        )
    for seq in (*seqs, *recordings):
        if runs.recording(seq).positions is None:
            raise ValueError(f"{runs.data}: sequence {seq} has no poses; training and scoring need them")


def _check_sessions(root: Path) -> None:
    """The first session is the database, the others are queries."""
    sessions = recording_names(root)
    if len(sessions) < 2:
        raise ValueError(f"{root}: expected two sessions or more, found {', '.join(sessions)}")


def _check_labels(runs: Runs, name: str) -> None:
    """Tables that compare the segmentation branch need labels, because without labels it learns nothing."""
    if not EXPERIMENTS[name].needs_labels:
        return
    for seq in recording_names(runs.data):
        if not runs.recording(seq).has_labels:
            raise ValueError(f"{name} is about semantics: expected labels in sequence {seq} of {runs.data}, found none")


def _check_methods(runs: Runs, seqs: Sequence[str], methods: Sequence[str], weights: Sequence[str]) -> None:
    for name in methods:
        if name not in HANDCRAFTED:
            raise ValueError(f"expected a handcrafted method, found {name!r}; available: {', '.join(HANDCRAFTED)}")
    for name in (*methods, *weights):
        needs = content_of(name)
        for seq in seqs:
            recording = runs.recording(seq)
            if needs != "images" and recording.has_images:
                raise ValueError(f"{name} needs points, found images in sequence {seq}; leave it out")
            if needs == "labelled points" and not recording.has_labels:
                raise ValueError(f"{name} needs labels, found none in sequence {seq}; leave it out")
