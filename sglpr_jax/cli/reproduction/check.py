"""What can be known to be wrong with a reproduction before anything is trained for it."""

import importlib.util
from collections.abc import Sequence

from sglpr_jax.cli.reproduction.experiments import EXPERIMENTS, VARIANTS
from sglpr_jax.cli.reproduction.runs import Runs
from sglpr_jax.data import ScanSequence, sequence_names
from sglpr_jax.evaluation.baselines import BASELINES


def check(runs: Runs, names: Sequence[str], seqs: Sequence[str], baselines: Sequence[str]) -> None:
    """Raise ValueError for an unknown baseline, drives without poses, points or labels where they are needed, or no
    second drive to train on; ImportError for figures without matplotlib."""
    if not names:
        raise ValueError(f"expected tables or figures, found none; there are all, {', '.join(EXPERIMENTS)}")
    if not seqs:
        found = ", ".join(sequence_names(runs.data))
        raise ValueError(f"{runs.data}: expected drives named as the paper's, found {found}; name yours with --seqs")
    if any(name.startswith("figure") for name in names) and not importlib.util.find_spec("matplotlib"):
        raise ImportError("figures need matplotlib: pip install 'sglpr-jax[viz]'")
    _check_drives(runs, seqs)
    for name in names:
        _check_labels(runs, name)
        if EXPERIMENTS[name].beside_baselines:
            _check_baselines(runs, seqs, baselines)


def _check_drives(runs: Runs, seqs: Sequence[str]) -> None:
    drives = sequence_names(runs.data)
    if len(drives) < 2:
        raise ValueError(f"{runs.data}: expected two drives or more, to train and test on, found {', '.join(drives)}")
    for seq in (*seqs, *drives):
        if runs.drive(seq).positions is None:
            raise ValueError(f"{runs.data}: sequence {seq} has no poses; training and scoring need them")


def _check_labels(runs: Runs, name: str) -> None:
    """Without labels a segmentation branch has nothing to learn: tables that compare it would compare nothing."""
    changes = [change for variant in EXPERIMENTS[name].variants for change in VARIANTS[variant].changes]
    about_semantics = any(change.startswith(("loss.", "model.categories", "model.head.input")) for change in changes)
    if not (about_semantics or name == "figure7"):
        return
    for seq in sequence_names(runs.data):
        if not runs.drive(seq).has_labels:
            raise ValueError(f"{name} is about semantics: expected labels in sequence {seq} of {runs.data}, found none")


def _check_baselines(runs: Runs, seqs: Sequence[str], baselines: Sequence[str]) -> None:
    for name in baselines:
        if name not in BASELINES:
            raise ValueError(f"no method {name!r} without training; there are {', '.join(BASELINES)}")
        needs = BASELINES[name].input
        for seq in seqs:
            drive = runs.drive(seq)
            if needs != "images" and not isinstance(drive, ScanSequence):
                raise ValueError(f"{name} needs points, found images in sequence {seq}; leave it out of --baselines")
            if needs == "labelled points" and not drive.has_labels:
                raise ValueError(f"{name} needs labels, found none in sequence {seq}; leave it out of --baselines")
