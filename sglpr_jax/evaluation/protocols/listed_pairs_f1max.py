"""Protocol of listed pairs with scores, for published lists and for methods without descriptors."""

from dataclasses import replace

import numpy as np
from jaxtyping import Bool, Float, Int

from sglpr_jax.evaluation.protocols.pairs import pair_distances, score_pairs
from sglpr_jax.evaluation.protocols.pairs_f1max import GAP, NEGATIVE_M, POSITIVE_M
from sglpr_jax.evaluation.protocols.protocol import Protocol
from sglpr_jax.evaluation.protocols.result import Result
from sglpr_jax.evaluation.protocols.source import ScoredPairs, check_frames
from sglpr_jax.retrieval.descriptor_file import DescriptorFile


def score_listed_pairs(
    file: DescriptorFile, pairs: Int[np.ndarray, "p 2"], labels: Bool[np.ndarray, " p"] | None = None
) -> ScoredPairs:
    """Score pairs of rows of a descriptor file by the negated distances of their descriptors."""
    check_frames("pairs of", pairs, 0, len(file))
    return ScoredPairs(pairs, -pair_distances(file, pairs.T), labels, file.positions, file.pose_source)


def listed_pairs_f1max(listed: ScoredPairs, *, seed: int = 0) -> Result:
    """Score listed pairs by F1max. SSC's published lists (`neg_100`) give the scores in the tables of SSC and RINet.

    Pairs without labels are labelled as in `pairs_f1max`, with distances in x and y. A pair is positive if its frames
    are less than 3 m and more than 50 frames apart, and negative if they are more than 20 m apart. Other pairs are
    ignored. The interval resamples the first frames of the pairs.
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
    assert listed.positions is not None  # checked by `ScoredPairs`
    positive, negative = _label(listed.pairs, listed.positions[:, :2])
    rule = f"{POSITIVE_M:g} m / {NEGATIVE_M:g} m, pairs as listed"
    result = replace(result, rule=rule, dimensions=2, pose_source=listed.pose_source)
    counted = positive | negative
    return score_pairs(result, listed.pairs[counted].T, listed.scores[counted], positive[counted], seed=seed)


def _label(
    pairs: Int[np.ndarray, "p 2"], positions: Float[np.ndarray, "n 2"]
) -> tuple[Bool[np.ndarray, " p"], Bool[np.ndarray, " p"]]:
    """Return which pairs are positive and which are negative. A pair may be neither."""
    i, j = pairs.T
    apart = np.linalg.norm(positions[i] - positions[j], axis=1)
    return (apart < POSITIVE_M) & (np.abs(i - j) > GAP), apart > NEGATIVE_M


LISTED_PAIRS_F1MAX = Protocol(
    "listed-pairs-f1max",
    listed_pairs_f1max,
    rule="pairs of frames as listed; without labels: same place below 3 m, different beyond 20 m, in x and y",
    source="SSC, RINet: the lists that they publish",
    takes=("scored pairs",),
    returns="F1max",
)
