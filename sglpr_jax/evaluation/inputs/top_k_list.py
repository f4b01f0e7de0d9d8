"""Top-k lists: `query: frame frame ...` on every line, or `query: frame=score ...`, best first.

The colon tells them from scored pairs. A query without an answer is `query:`.
"""

from pathlib import Path

import numpy as np

from sglpr_jax.data.formats.trajectory import Trajectory
from sglpr_jax.evaluation.inputs.positions import needed
from sglpr_jax.evaluation.inputs.text_list import as_frame, as_score, check_rows, padded, read_lines
from sglpr_jax.evaluation.protocols import TopK

Answer = tuple[int, float | None]
"""A retrieved frame and its score, if it has one."""


def is_top_k_list(path: Path) -> bool:
    """Whether the first line that says something has a colon."""
    return ":" in next((line for _, line in read_lines(path)), "")


def read_top_k_list(path: Path, trajectory: Trajectory | None, *, sequence: str) -> TopK:
    """Read the frames retrieved for each query; a higher score is closer, and all have one or none has.

    Raises ValueError naming the line that is malformed or names a frame without a pose, or the file where positions
    are missing.
    """
    trajectory = needed(path, trajectory)
    where = [place for place, _ in read_lines(path)]
    queries, answers = zip(*(_read_line(place, line) for place, line in read_lines(path)), strict=True)
    nearest = padded([[frame for frame, _ in row] for row in answers], fill=-1).astype(np.int64)
    frames = np.column_stack([queries, nearest])
    check_rows(where, frames, len(trajectory.positions), trajectory.source)
    try:
        return TopK(
            sequence=sequence,
            positions=trajectory.positions,
            times=trajectory.times,
            pose_source=trajectory.source,
            queries=frames[:, 0],
            nearest=nearest,
            scores=_scores(answers),
        )
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from error


def _read_line(where: str, line: str) -> tuple[int, list[Answer]]:
    query, colon, retrieved = line.partition(":")
    if not colon:
        raise ValueError(f"{where}: expected `query: frame frame ...`, found {line.strip()[:80]!r}")
    return as_frame(query.strip(), where), [_answer(word, where) for word in retrieved.split()]


def _answer(word: str, where: str) -> Answer:
    frame, equals, score = word.partition("=")
    return as_frame(frame, where), as_score(score, where) if equals else None


def _scores(answers: tuple[list[Answer], ...]) -> np.ndarray | None:
    """Return the scores of all answers, or None where no answer has one; ValueError where only some have."""
    scores = [[score for _, score in row] for row in answers]
    missing = sum(score is None for row in scores for score in row)
    if missing == sum(map(len, scores)):
        return None
    if missing:
        raise ValueError(f"expected a score for every retrieved frame or for none, found {missing} without")
    return padded([[score or 0.0 for score in row] for row in scores], fill=0.0)
