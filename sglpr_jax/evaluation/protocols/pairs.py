"""Protocols that classify pairs of frames by a threshold. The pairs are drawn from a sequence or listed in a file."""

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.spatial.distance import cdist

from sglpr_jax.evaluation.protocols.protocol import Kind, Protocol, ScoredPairs, positions_of
from sglpr_jax.evaluation.protocols.result import Result, with_f1_max
from sglpr_jax.retrieval.descriptor_file import DescriptorFile
from sglpr_jax.retrieval.distances import distance_function

POSITIVE_M, NEGATIVE_M = 3.0, 20.0
"""Frames closer than `POSITIVE_M` metres show the same place, frames farther apart than `NEGATIVE_M` different ones."""
GAP = 50
"""Frames with numbers that differ by at most `GAP` are neighbours, not revisits, in SSC's lists."""
BLOCK = 32
"""Number of frames compared with all others at a time."""
PAIR_BLOCK = 1 << 10
"""Number of pairs compared at a time. Their descriptors fit into the cache."""
PARTNERS = 64
"""The number of frames j compared with a frame i is padded to a multiple of this number."""

PairFilter = Callable[[Float[np.ndarray, "i j"], Int[np.ndarray, "i j"]], Bool[np.ndarray, "i j"]]
"""Selects pairs of frames (i, j), given their distance in metres and the difference i - j of their numbers."""


def is_revisit(metres: Float[np.ndarray, "..."], i_minus_j: Int[np.ndarray, "..."]) -> Bool[np.ndarray, "..."]:
    """Return which pairs of frames (i, j) are positive in SSC's lists: less than 3 m apart and i - j > 50."""
    return (metres < POSITIVE_M) & (i_minus_j > GAP)


def are_apart(metres: Float[np.ndarray, "..."], i_minus_j: Int[np.ndarray, "..."]) -> Bool[np.ndarray, "..."]:
    """Return which pairs of frames (i, j) are more than 20 m apart. Pairs with i <= j are omitted: each occurs once."""
    return (metres > NEGATIVE_M) & (i_minus_j > 0)


@dataclass(frozen=True, kw_only=True)
class DrawnPairs(Protocol):
    """F1max over pairs of frames: by default, positive pairs are less than 3 m and negative pairs more than 20 m apart.

    The bootstrap interval resamples the later frames i of the pairs (i, j). It does not draw other negative pairs.
    """

    source: str = "SSC, script/gen_pairs.py; RINet"
    published_on: str = "KITTI's own poses"
    dimensions: Literal[2, 3] = 2
    takes: tuple[Kind, ...] = ("descriptors",)
    positive: PairFilter = is_revisit
    """Selects positive pairs."""
    negatives_per_positive: int | None = None
    """Number of negative pairs drawn for each positive pair. If None, or if there are fewer, all negatives are used."""
    negatives_share: float | None = None
    """Probability of keeping each negative pair, used instead of `negatives_per_positive`."""

    def __call__(self, source: DescriptorFile, *, seed: int = 0) -> Result:
        """Score a descriptor file. `seed` is that of the drawn negative pairs and of the bootstrap interval."""
        positions = positions_of(source, self.dimensions)
        rng = np.random.default_rng(seed)
        positives = frame_pairs(positions, self.positive)
        if self.negatives_per_positive is not None:
            max_pairs = self.negatives_per_positive * len(positives)
            negatives = drawn_frame_pairs(positions, are_apart, max_pairs=max_pairs, rng=rng)
            selection = f"{self.negatives_per_positive} negatives per positive, seed {seed}"
        else:
            negatives = frame_pairs(positions, are_apart)
            selection = "all negatives"
        if self.negatives_share is not None:
            negatives = negatives[rng.random(len(negatives)) < self.negatives_share]
            selection = f"no gap, {self.negatives_share:.1%} of the negatives, seed {seed}"
        result = self.new_result(f"{POSITIVE_M:g} m / {NEGATIVE_M:g} m, {selection}", source)
        pairs = np.stack(np.divmod(np.concatenate([positives, negatives]), len(source)))  # from i * n + j to i, j
        is_positive = np.arange(pairs.shape[1]) < len(positives)
        if len(positives) == 0:  # no score, so the distances are not needed
            return _with_pair_score(result, pairs, np.zeros(pairs.shape[1]), is_positive, seed=seed)
        return _with_pair_score(result, pairs, -pair_distances(source, pairs), is_positive, seed=seed)


_RULE = "pairs of frames more than 50 apart: same place below 3 m, different beyond 20 m, in x and y; "
PAIRS_F1MAX = DrawnPairs(
    name="pairs-f1max",
    title="pairs F1max",
    rule=_RULE + "100 negatives drawn for each positive",
    negatives_per_positive=100,
    headline=True,
)
"""The published lists (lilin-hitcrt/SSC) have 1, 10, 20, 50 or 100 negatives for each positive. The tables use the list
with 100, `neg_100`. The seed of these lists is unknown. Another seed changes the score by 0.001 to 0.004."""
PAIRS_10_F1MAX = DrawnPairs(
    name="pairs-10-f1max", title="pairs F1max 1:10", rule=_RULE + "10 negatives for each", negatives_per_positive=10
)
PAIRS_1_F1MAX = DrawnPairs(
    name="pairs-1-f1max", title="pairs F1max 1:1", rule=_RULE + "1 negative for each", negatives_per_positive=1
)
PAIRS_ALL_F1MAX = DrawnPairs(name="pairs-all-f1max", title="pairs F1max 1:all", rule=_RULE + "all negatives")

SGPR_PAIRS_F1MAX = DrawnPairs(
    name="sgpr-pairs-f1max",
    title="SGPR pairs F1max",
    rule="pairs of frames: same place up to 3 m, different beyond 20 m, in x and y; 0.5 % of the negatives",
    source="SGPR, data_process/gen_sem_kitti_graph_pairs.py",
    positive=lambda metres, i_minus_j: (metres <= POSITIVE_M) & (i_minus_j >= 0),
    negatives_share=0.005,
)
"""Neighbouring frames are positive pairs, and so is each frame with itself. Most positive pairs are therefore easy, and
even a recording without a revisit has a score. The published code (kxhit/SG_PR) skips scans with few objects; here all
scans are used."""


@dataclass(frozen=True, kw_only=True)
class ListedPairs(Protocol):
    """F1max over listed pairs with scores, for published lists and for methods without descriptors.

    SSC's lists (`neg_100`) give the scores in the tables of SSC and RINet. Pairs without labels are labelled by their
    positions: positive below 3 m and more than 50 frames apart, negative beyond 20 m, else ignored. The bootstrap
    interval resamples the first frames of the pairs.
    """

    def __call__(self, source: ScoredPairs, *, seed: int = 0) -> Result:
        """Score listed pairs. `seed` is that of the bootstrap interval."""
        if source.labels is not None:
            result = replace(self.new_result("labels as listed"), dimensions=None)
            return _with_pair_score(result, source.pairs.T, source.scores, source.labels, seed=seed)
        assert source.positions is not None  # checked by `ScoredPairs`
        i, j = source.pairs.T
        metres = np.linalg.norm((source.positions[i] - source.positions[j])[:, : self.dimensions], axis=1)
        positive = is_revisit(metres, np.abs(i - j))
        counted = positive | (metres > NEGATIVE_M)
        result = self.new_result(f"{POSITIVE_M:g} m / {NEGATIVE_M:g} m, pairs as listed", source)
        return _with_pair_score(result, source.pairs[counted].T, source.scores[counted], positive[counted], seed=seed)


LISTED_PAIRS_F1MAX = ListedPairs(
    name="listed-pairs-f1max",
    title="listed pairs F1max",
    rule="pairs of frames as listed; without labels: same place below 3 m, different beyond 20 m, in x and y",
    source="SSC, RINet: the lists that they publish",
    published_on="KITTI's own poses",
    dimensions=2,
    takes=("scored pairs",),
)


def frame_pairs(positions: Float[np.ndarray, "n d"], is_selected: PairFilter) -> Int[np.ndarray, " pairs"]:
    """Return the number i * n + j of every selected pair of frames (i, j), in increasing order."""
    blocks = _selected_in_blocks(positions, is_selected)
    return np.concatenate([first_pair + np.flatnonzero(selected) for first_pair, selected in blocks])


def drawn_frame_pairs(
    positions: Float[np.ndarray, "n d"], is_selected: PairFilter, *, max_pairs: int, rng: np.random.Generator
) -> Int[np.ndarray, " pairs"]:
    """Draw up to `max_pairs` of the selected pairs (i, j) without replacement. Return i * n + j in increasing order.

    The result equals a sorted `rng.choice` from `frame_pairs`, but only one block of the pairs is in memory at a time.
    """
    counts = [int(np.count_nonzero(selected)) for _, selected in _selected_in_blocks(positions, is_selected)]
    block_starts = np.cumsum([0, *counts[:-1]])  # rank of the first pair of each block among all selected pairs
    drawn_ranks = np.sort(rng.choice(sum(counts), min(max_pairs, sum(counts)), replace=False))
    drawn_in_blocks = np.split(drawn_ranks, np.searchsorted(drawn_ranks, block_starts[1:]))
    blocks = _selected_in_blocks(positions, is_selected)
    pairs = []
    for (first_pair, selected), ranks, block_start in zip(blocks, drawn_in_blocks, block_starts, strict=True):
        pairs.append(first_pair + np.flatnonzero(selected)[ranks - block_start])
    return np.concatenate(pairs)


def _selected_in_blocks(
    positions: Float[np.ndarray, "n d"], is_selected: PairFilter
) -> Iterator[tuple[int, Bool[np.ndarray, "block n"]]]:
    """For each block of frames i, yield the number i * n of its first pair, and which pairs (i, j) are selected."""
    n = len(positions)
    for start in range(0, n, BLOCK):
        i_minus_j = np.arange(start, min(start + BLOCK, n))[:, None] - np.arange(n)[None, :]
        yield start * n, is_selected(cdist(positions[start : start + BLOCK], positions), i_minus_j)


def pair_distances(file: DescriptorFile, pairs: Int[np.ndarray, "2 pairs"]) -> Float[np.ndarray, " pairs"]:
    """Return the distance between the descriptors of each pair of frames, by the distance function of the file."""
    pair_distance = np.empty(pairs.shape[1])
    if file.distance == "l2":
        for start in range(0, pairs.shape[1], PAIR_BLOCK):
            block = slice(start, start + PAIR_BLOCK)
            i, j = pairs[:, block]
            pair_distance[block] = np.linalg.norm(file.descriptors[i] - file.descriptors[j], axis=1)
        return pair_distance
    # Other distance functions compare two arrays of descriptors. One call compares a frame i with all frames j that it
    # has pairs with. The frames j are repeated up to a multiple of `PARTNERS`, so that XLA compiles for few shapes.
    compare = distance_function(file.distance)
    order = np.argsort(pairs[0], kind="stable")
    first_pair_of_each_i = np.flatnonzero(np.diff(pairs[0][order])) + 1
    for columns in np.split(order, first_pair_of_each_i):
        i = pairs[0, columns[:1]]
        j = np.resize(pairs[1, columns], math.ceil(len(columns) / PARTNERS) * PARTNERS)
        pair_distance[columns] = compare(file.descriptors[i], file.descriptors[j])[0, : len(columns)]
    return pair_distance


def _with_pair_score(
    result: Result,
    pairs: Int[np.ndarray, "2 pairs"],
    scores: Float[np.ndarray, " pairs"],
    positive: Bool[np.ndarray, " pairs"],
    *,
    seed: int,
) -> Result:
    """Return `result` with the counts of pairs and, if a pair is positive, with F1max, its curve and its interval."""
    result = replace(result, counts={"positive pairs": int(positive.sum()), "negative pairs": int((~positive).sum())})
    if not positive.any():
        return result
    # The highest F1 is at the score of a positive pair: any other threshold can be raised to one and rejects negatives.
    thresholds = np.unique(scores[positive])
    flags = {"true_if_accepted": positive, "false_if_accepted": ~positive, "missed_if_rejected": positive}
    return with_f1_max(result, scores, query=pairs[0], seed=seed, thresholds=thresholds, **flags)
