"""Reader of top-k lists.

Each line is `query: frame frame ...` or `query: frame=score ...`, best first. A line `query:` has no answer. The colon
distinguishes top-k lists from scored pairs.
"""

from pathlib import Path

import numpy as np

from sglpr_jax.data.formats.pose_files import Trajectory
from sglpr_jax.evaluation.inputs.positions import needed
from sglpr_jax.evaluation.inputs.text_list import as_frame, as_score, check_rows, padded, read_lines
from sglpr_jax.evaluation.protocols.source import TopK
from sglpr_jax.files import naming

Answer = tuple[int, float | None]
"""A retrieved frame and its score, or None without a score."""


def is_top_k_list(path: Path) -> bool:
    """Return whether the first line that is not empty or a comment has a colon."""
    return ":" in next((line for _, line in read_lines(path)), "")


def read_top_k_list(path: Path, trajectory: Trajectory | None, *, sequence: str) -> TopK:
    """Read the frames retrieved for each query. Higher scores mean closer. Either all frames have a score or none has.

    Raises ValueError if a line is malformed or names a frame without a pose, or if positions are missing. The message
    names the line or the file.
    """
    trajectory = needed(path, trajectory)
    where = [place for place, _ in read_lines(path)]
    queries, answers = zip(*(_read_line(place, line) for place, line in read_lines(path)), strict=True)
    nearest = padded([[frame for frame, _ in row] for row in answers], fill=-1).astype(np.int64)
    frames = np.column_stack([queries, nearest])
    check_rows(where, frames, len(trajectory.positions), trajectory.source)
    with naming(path):
        return TopK(
            sequence=sequence,
            positions=trajectory.positions,
            times=trajectory.times,
            pose_source=trajectory.source,
            queries=frames[:, 0],
            nearest=nearest,
            scores=_scores(answers),
        )


def _read_line(where: str, line: str) -> tuple[int, list[Answer]]:
    query, colon, retrieved = line.partition(":")
    if not colon:
        raise ValueError(f"{where}: expected `query: frame frame ...`, found {line.strip()[:80]!r}")
    return as_frame(query.strip(), where), [_answer(word, where) for word in retrieved.split()]


def _answer(word: str, where: str) -> Answer:
    frame, equals, score = word.partition("=")
    return as_frame(frame, where), as_score(score, where) if equals else None


def _scores(answers: tuple[list[Answer], ...]) -> np.ndarray | None:
    """Return the scores of all answers, or None without scores. Raises ValueError if only some answers have a score."""
    scores = [[score for _, score in row] for row in answers]
    missing = sum(score is None for row in scores for score in row)
    if missing == sum(map(len, scores)):
        return None
    if missing:
        raise ValueError(f"expected a score for every retrieved frame or for none, found {missing} without a score")
    return padded([[score or 0.0 for score in row] for row in scores], fill=0.0)
