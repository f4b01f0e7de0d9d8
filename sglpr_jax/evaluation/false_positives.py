"""Worst false positives: wrong answers with the smallest descriptor distance."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from sglpr_jax.evaluation.protocols.protocol import Decision, Result

APART = 10
"""Minimum gap between the queries of two shown mistakes, in frames. Neighbouring frames make the same mistake."""


@dataclass(frozen=True)
class FalsePositive:
    """Answer that is accepted at the threshold of F1max but shows another place."""

    query: int
    answer: int
    metres: float
    """Distance between the positions of the two frames, in metres and in the dimensions of the protocol."""
    distance: float
    """Distance between the two descriptors."""


def worst_false_positives(result: Result, positions: Float[np.ndarray, "n 3"], *, most: int = 6) -> list[FalsePositive]:
    """Return up to `most` false positives, in order of descriptor distance.

    The list is empty if the protocol applies no threshold to answers.
    """
    if result.answers is None or result.answer_distances is None or result.decisions is None:
        return []
    positions = positions[:, : result.dimensions or 3]
    wrong = np.flatnonzero(result.decisions == Decision.FALSE_POSITIVE)
    worst: list[FalsePositive] = []
    for query in wrong[np.argsort(result.answer_distances[wrong], kind="stable")].tolist():
        if len(worst) < most and all(abs(query - other.query) >= APART for other in worst):
            answer = int(result.answers[query])
            metres = float(np.linalg.norm(positions[query] - positions[answer]))
            worst.append(FalsePositive(query, answer, metres, float(result.answer_distances[query])))
    return worst
