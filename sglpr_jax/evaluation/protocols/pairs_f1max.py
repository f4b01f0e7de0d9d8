"""Protocol of SSC and RINet: F1max over pairs of frames."""

from functools import partial

import numpy as np
from jaxtyping import Bool, Float, Int

from sglpr_jax.evaluation.protocols.pairs import drawn_frame_pairs, frame_pairs, score_drawn_pairs
from sglpr_jax.evaluation.protocols.protocol import Protocol
from sglpr_jax.evaluation.protocols.result import Result
from sglpr_jax.evaluation.protocols.source import positions_of
from sglpr_jax.retrieval.descriptor_file import DescriptorFile

POSITIVE_M, NEGATIVE_M = 3.0, 20.0
GAP = 50
"""Frames at most this number of frames apart are neighbours, not revisits."""


def pairs_f1max(file: DescriptorFile, *, negatives_per_positive: int | None = 100, seed: int = 0) -> Result:
    """Score pairs of frames as SSC and RINet do (`neg_100`): 3 m / 20 m in x and y, 100 negatives per positive.

    Positive pairs are all pairs less than 3 m and more than 50 frames apart. Negative pairs are more than 20 m apart
    and drawn without replacement. All negative pairs are used if there are too few, or with
    `negatives_per_positive=None`. The seed of the published lists is unknown. Another seed changes the score by 0.001
    to 0.004. Published on KITTI's own poses (lilin-hitcrt/SSC, script/gen_pairs.py). The published lists have 1, 10,
    20, 50 and 100 negatives for each positive, and the tables use 100. The interval resamples the later frames of the
    pairs and does not redraw the negatives.
    """
    positions = positions_of(file, 2)
    positive = positive_pairs(positions)
    if negatives_per_positive is None:
        negative, each = frame_pairs(positions, are_negative), "all negatives"
    else:
        most, rng = negatives_per_positive * len(positive), np.random.default_rng(seed)
        negative = drawn_frame_pairs(positions, are_negative, most=most, rng=rng)
        each = f"{negatives_per_positive} negatives per positive, seed {seed}"
    result = Result(
        name="pairs F1max" if negatives_per_positive == 100 else f"pairs F1max 1:{negatives_per_positive or 'all'}",
        rule=f"{POSITIVE_M:g} m / {NEGATIVE_M:g} m, {each}",
        dimensions=2,
        pose_source=file.pose_source,
        published_on="KITTI's own poses",
    )
    return score_drawn_pairs(file, result, positive, negative, seed=seed)


def are_negative(apart: Float[np.ndarray, "i j"], gap: Int[np.ndarray, "i j"]) -> Bool[np.ndarray, "i j"]:
    """Return which pairs (i, j) show different places. Only pairs with i > j are selected, so each pair occurs once."""
    return (apart > NEGATIVE_M) & (gap > 0)


def positive_pairs(positions: Float[np.ndarray, "n 2"]) -> Int[np.ndarray, " pairs"]:
    """Return every positive pair (i, j) of SSC's lists as i * n + j: less than 3 m apart and i - j > 50."""
    return frame_pairs(positions, lambda apart, gap: (apart < POSITIVE_M) & (gap > GAP))


_PAIRS = partial(
    Protocol,
    source="SSC, script/gen_pairs.py; RINet",
    takes=("descriptors",),
    returns="F1max",
)
_RULE = "pairs of frames more than 50 apart: same place below 3 m, different beyond 20 m, in x and y; "
PAIRS_F1MAX = _PAIRS("pairs-f1max", pairs_f1max, rule=_RULE + "100 negatives drawn for each positive", headline=True)
PAIRS_10_F1MAX = _PAIRS(
    "pairs-10-f1max", partial(pairs_f1max, negatives_per_positive=10), rule=_RULE + "10 negatives for each"
)
PAIRS_1_F1MAX = _PAIRS(
    "pairs-1-f1max", partial(pairs_f1max, negatives_per_positive=1), rule=_RULE + "1 negative for each"
)
PAIRS_ALL_F1MAX = _PAIRS(
    "pairs-all-f1max", partial(pairs_f1max, negatives_per_positive=None), rule=_RULE + "all negatives"
)
