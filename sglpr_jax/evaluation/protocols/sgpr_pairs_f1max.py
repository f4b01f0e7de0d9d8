"""Protocol of SGPR."""

import numpy as np

from sglpr_jax.evaluation.protocols.pairs import frame_pairs, score_drawn_pairs
from sglpr_jax.evaluation.protocols.protocol import Protocol
from sglpr_jax.evaluation.protocols.result import Result
from sglpr_jax.evaluation.protocols.source import positions_of
from sglpr_jax.retrieval.descriptor_file import DescriptorFile

POSITIVE_M, NEGATIVE_M = 3.0, 20.0
NEGATIVE_SHARE = 0.005
"""Fraction of the negative pairs that is kept."""


def sgpr_pairs_f1max(file: DescriptorFile, *, seed: int = 0) -> Result:
    """Score pairs of frames as SGPR does: 3 m / 20 m in x and y, without a gap, 0.5 % of the negatives.

    Positive pairs are all pairs at most 3 m apart, including neighbouring frames and each frame with itself. Negative
    pairs are more than 20 m apart, and each is kept with a probability of 0.005. Most positive pairs are therefore
    easy, and even a recording without a revisit has a score. Published on KITTI's own poses (kxhit/SG_PR,
    data_process/gen_sem_kitti_graph_pairs.py). The published code skips scans with few objects. Here all scans are
    used. The interval resamples the later frames of the pairs and does not redraw the negatives.
    """
    positions = positions_of(file, 2)
    positive = frame_pairs(positions, lambda apart, gap: (apart <= POSITIVE_M) & (gap >= 0))
    negative = frame_pairs(positions, lambda apart, gap: (apart > NEGATIVE_M) & (gap > 0))
    negative = negative[np.random.default_rng(seed).random(len(negative)) < NEGATIVE_SHARE]
    result = Result(
        name="SGPR pairs F1max",
        rule=f"{POSITIVE_M:g} m / {NEGATIVE_M:g} m, no gap, {NEGATIVE_SHARE:.1%} of the negatives, seed {seed}",
        dimensions=2,
        pose_source=file.pose_source,
        published_on="KITTI's own poses",
    )
    return score_drawn_pairs(file, result, positive, negative, seed=seed)


SGPR_PAIRS_F1MAX = Protocol(
    "sgpr-pairs-f1max",
    sgpr_pairs_f1max,
    rule="pairs of frames: same place up to 3 m, different beyond 20 m, in x and y; 0.5 % of the negatives",
    source="SGPR, data_process/gen_sem_kitti_graph_pairs.py",
    takes=("descriptors",),
    returns="F1max",
)
