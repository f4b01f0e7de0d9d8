"""The worst false positives: the wrong answers that a method is surest of."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from sglpr_jax.evaluation.protocols import Decision, Result

APART = 10
"""Of mistakes so few frames from each other only the worst is shown: neighbouring frames make the same one."""


@dataclass(frozen=True)
class FalsePositive:
    """An answer accepted at the threshold of F1max that is of another place."""

    query: int
    answer: int
    metres: float
    """How far apart the two frames were taken, in as many dimensions as the protocol has."""
    distance: float
    """Of the descriptors."""


def worst_false_positives(result: Result, positions: Float[np.ndarray, "n 3"], *, most: int = 6) -> list[FalsePositive]:
    """Return up to `most` false positives, that of the smallest descriptor distance first.

    None are found where the protocol puts no threshold on answers, so that none is accepted.
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
