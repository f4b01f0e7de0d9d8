"""Pairs of frames that come with a score: a published list, or what a method says that gives no descriptors."""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, Int

from sglpr_jax.evaluation.protocols.pairs import pair_distances, score_pairs
from sglpr_jax.evaluation.protocols.result import Result
from sglpr_jax.evaluation.protocols.source import check_frames
from sglpr_jax.evaluation.protocols.ssc import GAP
from sglpr_jax.poses import NEGATIVE_M, POSITIVE_M
from sglpr_jax.retrieval.descriptor_file import DescriptorFile


@dataclass(frozen=True, eq=False)
class ScoredPairs:
    """Pairs of frames of a sequence, each with a score and perhaps a label.

    Raises ValueError where the list is empty, a frame is out of range, or the numbers of rows differ.
    """

    pairs: np.ndarray
    """(p, 2) integers: two frames, the query first."""
    scores: np.ndarray
    """(p,) float64, higher is closer."""
    labels: np.ndarray | None = None
    """(p,) bool: one place or not. None: the positions tell."""
    positions: np.ndarray | None = None
    """(n, 3) float64, metres, z up, of every frame. Needed where there are no labels."""
    pose_source: str | None = None

    def __post_init__(self):
        p = len(self.pairs)
        if p == 0:
            raise ValueError("expected a list with at least one pair, found none")
        if self.pairs.shape != (p, 2) or len(self.scores) != p or (self.labels is not None and len(self.labels) != p):
            raise ValueError(f"expected {p} pairs of frames, with a score each and a label each or none, found others")
        if self.labels is None and self.positions is None:
            raise ValueError("expected labels, or positions to tell them from, found neither")
        n = np.iinfo(np.int64).max if self.positions is None else len(self.positions)
        check_frames("pairs of", self.pairs, 0, n)


def score_listed_pairs(
    file: DescriptorFile, pairs: Int[np.ndarray, "p 2"], labels: Bool[np.ndarray, " p"] | None = None
) -> ScoredPairs:
    """Return listed pairs of rows of a descriptor file with the negated distances of their descriptors."""
    check_frames("pairs of", pairs, 0, len(file))
    return ScoredPairs(pairs, -pair_distances(file, pairs.T), labels, file.positions, file.pose_source)


def scored_pairs_f1max(listed: ScoredPairs, *, seed: int = 0) -> Result:
    """Score listed pairs by F1max: with SSC's published lists (`neg_100`), the numbers of SSC's and RINet's tables.

    Pairs without labels are labelled as `pairs_f1max` would: positive less than 3 m and more than 50 frames apart,
    negative more than 20 m apart, in x and y; what is neither is left out. The interval resamples the first frames
    of the pairs.
    """
    result = Result(
        name="listed pairs F1max",
        rule="labels as listed",
        dimensions=None,
        pose_source=None,
        published_on="KITTI's own poses",
    )
    if listed.labels is not None:
        return score_pairs(result, listed.pairs.T, listed.scores, listed.labels, seed=seed)
    assert listed.positions is not None  # `ScoredPairs` has seen to it
    positive, negative = _label(listed.pairs, listed.positions[:, :2])
    rule = f"{POSITIVE_M:g} m / {NEGATIVE_M:g} m, pairs as listed"
    result = replace(result, rule=rule, dimensions=2, pose_source=listed.pose_source)
    counted = positive | negative
    return score_pairs(result, listed.pairs[counted].T, listed.scores[counted], positive[counted], seed=seed)


def _label(
    pairs: Int[np.ndarray, "p 2"], positions: Float[np.ndarray, "n 2"]
) -> tuple[Bool[np.ndarray, " p"], Bool[np.ndarray, " p"]]:
    """Return which pairs are positive and which are negative; a pair may be neither."""
    i, j = pairs.T
    apart = np.linalg.norm(positions[i] - positions[j], axis=1)
    return (apart < POSITIVE_M) & (np.abs(i - j) > GAP), apart > NEGATIVE_M
