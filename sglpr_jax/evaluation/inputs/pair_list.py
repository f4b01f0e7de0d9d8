"""Reader of lists of scored pairs.

Each line is `i j score` or `i j score label`. Label 1 means the same place, label 0 different places.
"""

from pathlib import Path

import numpy as np

from sglpr_jax.data.formats.pose_files import Trajectory
from sglpr_jax.evaluation.inputs.positions import needed
from sglpr_jax.evaluation.inputs.text_list import as_frame, as_score, check_rows, read_lines
from sglpr_jax.evaluation.protocols.source import ScoredPairs

LABELS = {"0": False, "1": True}


def read_pair_list(path: Path, trajectory: Trajectory | None) -> ScoredPairs:
    """Read pairs of frames, the query first. A higher score means more similar.

    Pairs without a label are labelled by the distance between their positions, so these are needed then.

    Raises ValueError if the file is empty, if a line is malformed or names a frame without a pose, or if positions are
    needed but missing. The message names the line or the file.
    """
    where, rows = _read(path)
    pairs = np.array([[as_frame(word, place) for word in row[:2]] for place, row in zip(where, rows, strict=True)])
    scores = np.array([as_score(row[2], place) for place, row in zip(where, rows, strict=True)])
    labels = np.array([_label(row[3], place) for place, row in zip(where, rows, strict=True) if len(row) == 4])
    trajectory = trajectory if labels.size else needed(path, trajectory)
    if trajectory is None:
        return ScoredPairs(pairs, scores, labels)
    check_rows(where, pairs, len(trajectory.positions), trajectory.source)
    return ScoredPairs(pairs, scores, labels if labels.size else None, trajectory.positions, trajectory.source)


def _read(path: Path) -> tuple[list[str], list[list[str]]]:
    """Return location and words of all lines. Every line has 3 words, or every line has 4."""
    lines = [(where, line.split()) for where, line in read_lines(path)]
    if not lines:
        raise ValueError(f"{path}: expected lines `i j score [label]` or `query: frame frame ...`, found none")
    columns = len(lines[0][1])
    for where, words in lines:
        if len(words) != columns or columns not in (3, 4):
            expected = columns if columns in (3, 4) else "3 or 4"
            raise ValueError(
                f"{where}: expected {expected} numbers `i j score [label]`, found {' '.join(words)[:80]!r}"
            )
    return [where for where, _ in lines], [words for _, words in lines]


def _label(word: str, where: str) -> bool:
    if word not in LABELS:
        raise ValueError(f"{where}: expected a label 0 or 1, found {word!r}")
    return LABELS[word]
