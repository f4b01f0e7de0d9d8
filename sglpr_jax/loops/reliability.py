"""Do the probabilities of loops mean what they say? Pairs in bins of probability, and how many of each are loops."""

import itertools
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from sglpr_jax.loops.candidates import Candidate
from sglpr_jax.loops.probability import Evidence, LoopModel
from sglpr_jax.same_place import NEGATIVE_M

EDGES = (0.0, 0.01, 0.1, 0.3, 0.5, 0.7, 0.9, 0.99, 1.0)
"""Narrow where loops are accepted and refused."""


class Bin(NamedTuple):
    """Pairs of nearly equal probability."""

    low: float
    high: float
    """Of the probabilities; the last bin has 1, too."""
    pairs: int
    loops: int
    """So many of the pairs are loops."""
    said: float
    """The mean of their probabilities."""

    @property
    def share(self) -> float:
        """Of loops among the pairs."""
        return self.loops / self.pairs


def reliability(
    probability: Float[np.ndarray, " n"], is_loop: Bool[np.ndarray, " n"], *, edges: Sequence[float] = EDGES
) -> tuple[Bin, ...]:
    """The bins that hold pairs, in order of probability."""
    found = []
    for low, high in itertools.pairwise(edges):
        chosen = (probability >= low) & ((probability < high) | (high == edges[-1]))
        if chosen.any():
            said = float(probability[chosen].mean().clip(low, high))  # the mean of equal numbers may be rounded out
            found.append(Bin(low, high, int(chosen.sum()), int(is_loop[chosen].sum()), said))
    return tuple(found)


def reliability_of(
    candidates: Sequence[Candidate], model: LoopModel, positions: Float[np.ndarray, "n 3"]
) -> tuple[Bin, ...]:
    """The bins of candidates whose true positions are known: loops are up to 10 m apart, others more than 20 m."""
    if not candidates:
        return ()
    evidence, is_loop = labelled(candidates, positions)
    return reliability(model.probability(evidence), is_loop)


def labelled(
    candidates: Sequence[Candidate], positions: Float[np.ndarray, "n 3"], *, loop_m: float = 10.0
) -> tuple[Evidence, Bool[np.ndarray, " m"]]:
    """The evidence of candidates whose true positions are known, and whether each is a loop: up to `loop_m` apart.

    Candidates between that and 20 m are left out.
    """
    apart = np.array([np.linalg.norm(positions[one.query] - positions[one.match]) for one in candidates])
    clear = (apart <= loop_m) | (apart > NEGATIVE_M)
    chosen = [one.evidence for one, kept in zip(candidates, clear, strict=True) if kept]
    return Evidence.stack(chosen), apart[clear] <= loop_m
