"""Protocols of pairs: a threshold classifies pairs of frames, drawn from a sequence or listed with scores."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from jaxtyping import Bool, Float, Int

from sglpr_jax.evaluation.protocols.protocol import Kind, Protocol, ScoredPairs, positions_of
from sglpr_jax.evaluation.protocols.result import Result, with_f1_max
from sglpr_jax.retrieval.descriptor_file import DescriptorFile
from sglpr_jax.retrieval.distances import distance_function
from sglpr_jax.se3 import distances

POSITIVE_M, NEGATIVE_M = 3.0, 20.0
"""Distances of pairs of one place and of two places, in metres."""
GAP = 50
"""Frames at most this number of frames apart are neighbours, not revisits, in SSC's lists."""
BLOCK = 32
"""Number of frames compared with all others at a time."""
PAIR_BLOCK = 1 << 10
"""Number of pairs compared at a time. Their descriptors fit into the cache."""
PARTNERS = 64
"""The number of partners of a frame is padded to a multiple of this number."""

PairFilter = Callable[[Float[np.ndarray, "i j"], Int[np.ndarray, "i j"]], Bool[np.ndarray, "i j"]]
"""Selects pairs of frames (i, j), given their distance in metres and the number of frames i - j between them."""


def is_revisit(apart: Float[np.ndarray, "..."], gap: Int[np.ndarray, "..."]) -> Bool[np.ndarray, "..."]:
    """Return which pairs (i, j) are positive in SSC's lists: less than 3 m apart and i - j > 50."""
    return (apart < POSITIVE_M) & (gap > GAP)


def are_apart(apart: Float[np.ndarray, "..."], gap: Int[np.ndarray, "..."]) -> Bool[np.ndarray, "..."]:
    """Return which pairs (i, j) show different places. Only pairs with i > j are selected, so each pair occurs once."""
    return (apart > NEGATIVE_M) & (gap > 0)


@dataclass(frozen=True, kw_only=True)
class DrawnPairs(Protocol):
    """F1max over pairs of frames less than 3 m (positive) or more than 20 m (negative) apart.

    The interval resamples the later frames of the pairs and does not redraw the negatives.
    """

    source: str = "SSC, script/gen_pairs.py; RINet"
    published_on: str = "KITTI's own poses"
    dimensions: Literal[2, 3] = 2
    takes: tuple[Kind, ...] = ("descriptors",)
    positive: PairFilter = is_revisit
    """Selects positive pairs."""
    negatives_per_positive: int | None = None
    """Negative pairs for each positive pair, drawn without replacement. None or too few negatives: all of them."""
    negatives_share: float | None = None
    """Probability of each negative pair to be kept, instead of a number."""

    def __call__(self, source: DescriptorFile, *, seed: int = 0) -> Result:
        """Score a descriptor file. `seed` draws the negatives and the resamples."""
        positions, rng = positions_of(source, self.dimensions), np.random.default_rng(seed)
        positive = frame_pairs(positions, self.positive)
        if self.negatives_per_positive is not None:
            most = self.negatives_per_positive * len(positive)
            negative = drawn_frame_pairs(positions, are_apart, most=most, rng=rng)
            words = f"{self.negatives_per_positive} negatives per positive, seed {seed}"
        else:
            negative, words = frame_pairs(positions, are_apart), "all negatives"
        if self.negatives_share is not None:
            negative = negative[rng.random(len(negative)) < self.negatives_share]
            words = f"no gap, {self.negatives_share:.1%} of the negatives, seed {seed}"
        result = self.result(f"{POSITIVE_M:g} m / {NEGATIVE_M:g} m, {words}", source)
        pairs = np.stack(np.divmod(np.concatenate([positive, negative]), len(source)))
        is_positive = np.arange(pairs.shape[1]) < len(positive)
        scores = -pair_distances(source, pairs) if len(positive) else np.zeros(pairs.shape[1])
        return _score(result, pairs, scores, is_positive, seed=seed)


_RULE = "pairs of frames more than 50 apart: same place below 3 m, different beyond 20 m, in x and y; "
PAIRS_F1MAX = DrawnPairs(
    name="pairs-f1max",
    title="pairs F1max",
    rule=_RULE + "100 negatives drawn for each positive",
    negatives_per_positive=100,
    headline=True,
)
"""The published lists (lilin-hitcrt/SSC, `neg_100`) have 1, 10, 20, 50 and 100 negatives for each positive, and the
tables use 100. The seed of these lists is unknown. Another seed changes the score by 0.001 to 0.004."""
PAIRS_10_F1MAX = DrawnPairs(
    name="pairs-10-f1max",
    title="pairs F1max 1:10",
    rule=_RULE + "10 negatives for each",
    negatives_per_positive=10,
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
    positive=lambda apart, gap: (apart <= POSITIVE_M) & (gap >= 0),
    negatives_share=0.005,
)
"""Neighbouring frames and each frame with itself are positive, too. Most positive pairs are therefore easy, and even a
recording without a revisit has a score. The published code (kxhit/SG_PR) skips scans with few objects; here all scans
are used."""


@dataclass(frozen=True, kw_only=True)
class ListedPairs(Protocol):
    """F1max over listed pairs with scores, for published lists and for methods without descriptors.

    SSC's lists (`neg_100`) give the scores in the tables of SSC and RINet. Pairs without labels are labelled as in
    `PAIRS_F1MAX`; pairs that are neither positive nor negative are ignored. The interval resamples the first frames.
    """

    def __call__(self, source: ScoredPairs, *, seed: int = 0) -> Result:
        """Score listed pairs."""
        if source.labels is not None:
            labelled = replace(self.result("labels as listed"), dimensions=None)
            return _score(labelled, source.pairs.T, source.scores, source.labels, seed=seed)
        assert source.positions is not None  # checked by `ScoredPairs`
        i, j = source.pairs.T
        apart = np.linalg.norm((source.positions[i] - source.positions[j])[:, : self.dimensions], axis=1)
        positive = is_revisit(apart, np.abs(i - j))
        counted = positive | (apart > NEGATIVE_M)
        result = self.result(f"{POSITIVE_M:g} m / {NEGATIVE_M:g} m, pairs as listed", source)
        return _score(result, source.pairs[counted].T, source.scores[counted], positive[counted], seed=seed)


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
    """Return every selected pair of frames (i, j) as i * n + j, in increasing order."""
    blocks = _selected_in_blocks(positions, is_selected)
    return np.concatenate([first + np.flatnonzero(selected) for first, selected in blocks])


def drawn_frame_pairs(
    positions: Float[np.ndarray, "n d"], is_selected: PairFilter, *, most: int, rng: np.random.Generator
) -> Int[np.ndarray, " pairs"]:
    """Draw up to `most` pairs of `frame_pairs` without replacement, in increasing order.

    The result equals `rng.choice` on all pairs, but the list of all pairs is never stored.
    """
    ends = np.cumsum([np.count_nonzero(selected) for _, selected in _selected_in_blocks(positions, is_selected)])
    ranks = np.sort(rng.choice(ends[-1], min(most, ends[-1]), replace=False))
    ranks_of_blocks = np.split(ranks, np.searchsorted(ranks, ends[:-1]))
    blocks = zip(_selected_in_blocks(positions, is_selected), ranks_of_blocks, [0, *ends[:-1]], strict=True)
    return np.concatenate([first + np.flatnonzero(selected)[rows - start] for (first, selected), rows, start in blocks])


def _selected_in_blocks(
    positions: Float[np.ndarray, "n d"], is_selected: PairFilter
) -> Iterator[tuple[int, Bool[np.ndarray, "block n"]]]:
    """Yield the number of the first pair (i, j) and the selected pairs, for blocks of frames i."""
    n = len(positions)
    for start in range(0, n, BLOCK):
        gap = np.arange(start, min(start + BLOCK, n))[:, None] - np.arange(n)[None, :]
        yield start * n, is_selected(distances(positions[start : start + BLOCK], positions), gap)


def pair_distances(file: DescriptorFile, pairs: Int[np.ndarray, "2 pairs"]) -> Float[np.ndarray, " pairs"]:
    """Return the distance between the descriptors of each pair, by the kind of distance that the file states."""
    apart = np.empty(pairs.shape[1])
    if file.distance == "l2":
        for start in range(0, pairs.shape[1], PAIR_BLOCK):
            i, j = pairs[:, start : start + PAIR_BLOCK]
            apart[start : start + PAIR_BLOCK] = np.linalg.norm(file.descriptors[i] - file.descriptors[j], axis=1)
        return apart
    # Other distances are between sets: each first frame is compared with all its partners. These are repeated up to a
    # multiple of `PARTNERS`, so that a jitted distance compiles for few shapes.
    compare, order = distance_function(file.distance), np.argsort(pairs[0], kind="stable")
    for rows in np.split(order, np.flatnonzero(np.diff(pairs[0][order])) + 1):
        partners = np.resize(pairs[1, rows], -(-len(rows) // PARTNERS) * PARTNERS)
        apart[rows] = compare(file.descriptors[pairs[0, rows[:1]]], file.descriptors[partners])[0, : len(rows)]
    return apart


def _score(
    result: Result,
    pairs: Int[np.ndarray, "2 pairs"],
    scores: Float[np.ndarray, " pairs"],
    positive: Bool[np.ndarray, " pairs"],
    *,
    seed: int,
) -> Result:
    """Add counts and, if a pair is positive, F1max. The interval resamples the first frames with all their pairs."""
    result = replace(result, counts={"positive pairs": int(positive.sum()), "negative pairs": int((~positive).sum())})
    if not positive.any():
        return result
    # Between the scores of two positive pairs only precision falls, so the millions of negative scores are not needed.
    thresholds = np.unique(scores[positive])
    flags = {"true_if_accepted": positive, "false_if_accepted": ~positive, "missed_if_rejected": positive}
    return with_f1_max(result, scores, query=pairs[0], seed=seed, thresholds=thresholds, **flags)
