"""Reliability of loop probabilities: pairs in bins of probability, and the share of loops in each bin."""

import itertools
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from sglpr_jax.loops.comparison import Candidate
from sglpr_jax.loops.probability import Evidence, LoopModel
from sglpr_jax.same_place import NEGATIVE_M

EDGES = (0.0, 0.01, 0.1, 0.3, 0.5, 0.7, 0.9, 0.99, 1.0)
"""Edges of the bins. They are narrow where loops are accepted and rejected."""


class Bin(NamedTuple):
    """Pairs with similar probability."""

    low: float
    high: float
    """Range of the probabilities. The last bin includes 1."""
    pairs: int
    """Number of pairs."""
    loops: int
    """Number of pairs that are loops."""
    said: float
    """Mean probability of the pairs."""

    @property
    def share(self) -> float:
        """Share of loops among the pairs."""
        return self.loops / self.pairs


def reliability(
    probability: Float[np.ndarray, " n"], is_loop: Bool[np.ndarray, " n"], *, edges: Sequence[float] = EDGES
) -> tuple[Bin, ...]:
    """Sort pairs into bins. Returns the bins with pairs, in order of probability."""
    found = []
    for low, high in itertools.pairwise(edges):
        chosen = (probability >= low) & ((probability < high) | (high == edges[-1]))
        if chosen.any():
            said = float(probability[chosen].mean().clip(low, high))  # rounding may move the mean of equal numbers out
            found.append(Bin(low, high, int(chosen.sum()), int(is_loop[chosen].sum()), said))
    return tuple(found)


def calibration_error(bins: Sequence[Bin]) -> float:
    """Expected calibration error: mean difference between probability and share of loops, weighted by pairs."""
    pairs = np.array([one.pairs for one in bins])
    return float(pairs @ [abs(one.said - one.share) for one in bins] / pairs.sum())


def reliability_of(
    candidates: Sequence[Candidate], model: LoopModel, positions: Float[np.ndarray, "n 3"]
) -> tuple[Bin, ...]:
    """Reliability of candidates with known positions: loops are up to 10 m apart, others more than 20 m."""
    if not candidates:
        return ()
    evidence, is_loop = labelled(candidates, positions)
    return reliability(model.probability(evidence), is_loop)


def labelled(
    candidates: Sequence[Candidate], positions: Float[np.ndarray, "n 3"], *, loop_m: float = 10.0
) -> tuple[Evidence, Bool[np.ndarray, " m"]]:
    """Evidence of candidates with known positions, and whether each is a loop (at most `loop_m` apart).

    Candidates that are more than `loop_m` and at most 20 m apart are omitted.
    """
    apart = np.array([np.linalg.norm(positions[one.query] - positions[one.match]) for one in candidates])
    clear = (apart <= loop_m) | (apart > NEGATIVE_M)
    chosen = [one.evidence for one, kept in zip(candidates, clear, strict=True) if kept]
    return Evidence.stack(chosen), apart[clear] <= loop_m
