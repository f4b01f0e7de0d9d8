"""Positive and negative pairs of frames, drawn from a sequence or listed with scores."""

from collections.abc import Callable, Iterator
from dataclasses import replace

import numpy as np
from jaxtyping import Bool, Float, Int

from sglpr_jax import metrics
from sglpr_jax.evaluation.protocols.bootstrap import f1_max_interval
from sglpr_jax.evaluation.protocols.result import Result
from sglpr_jax.retrieval.descriptor_file import DescriptorFile
from sglpr_jax.retrieval.distances import distance_function
from sglpr_jax.se3 import distances

BLOCK = 32
"""Number of frames compared with all others at a time."""
PAIR_BLOCK = 1 << 10
"""Number of pairs compared at a time. Their descriptors fit into the cache."""
PARTNERS = 64
"""The number of partners of a frame is padded to a multiple of this number."""

Keep = Callable[[Float[np.ndarray, "i j"], Int[np.ndarray, "i j"]], Bool[np.ndarray, "i j"]]
"""Selects pairs of frames (i, j), given their distance in metres and the number of frames i - j between them."""


def score_pairs(
    result: Result,
    pairs: Int[np.ndarray, "2 pairs"],
    scores: Float[np.ndarray, " pairs"],
    positive: Bool[np.ndarray, " pairs"],
    *,
    seed: int,
) -> Result:
    """Complete `result` with counts and, if a pair is positive, with F1max, its curve and interval.

    The interval resamples the first frames. The pairs of a first frame are drawn or omitted together.
    """
    counts = {"positive pairs": int(positive.sum()), "negative pairs": int((~positive).sum())}
    result = replace(result, counts=counts)
    if not positive.any():
        return result
    # Between the scores of two positive pairs only precision falls, so the millions of negative scores are not needed.
    curve = metrics.classification_curve(scores, positive, thresholds=np.unique(scores[positive]))
    interval = f1_max_interval(
        scores,
        true_if_accepted=positive,
        false_if_accepted=~positive,
        missed_if_rejected=positive,
        query=pairs[0],
        seed=seed,
    )
    return replace(result, score=curve.f1_max, curve=curve, interval=interval)


def frame_pairs(positions: Float[np.ndarray, "n d"], keep: Keep) -> Int[np.ndarray, " pairs"]:
    """Return every ordered pair (i, j) that `keep` selects as i * n + j, in increasing order."""
    return np.concatenate([first + np.flatnonzero(kept) for first, kept in _kept_in_blocks(positions, keep)])


def drawn_frame_pairs(
    positions: Float[np.ndarray, "n d"], keep: Keep, *, most: int, rng: np.random.Generator
) -> Int[np.ndarray, " pairs"]:
    """Draw up to `most` pairs of `frame_pairs` without replacement, in increasing order.

    The result equals `rng.choice` on all pairs, but the list of all pairs is never stored.
    """
    ends = np.cumsum([np.count_nonzero(kept) for _, kept in _kept_in_blocks(positions, keep)])
    ranks = np.sort(rng.choice(ends[-1], min(most, ends[-1]), replace=False))
    of_blocks = np.split(ranks, np.searchsorted(ranks, ends[:-1]))
    blocks = zip(_kept_in_blocks(positions, keep), of_blocks, [0, *ends[:-1]], strict=True)
    return np.concatenate([first + np.flatnonzero(kept)[ranks - before] for (first, kept), ranks, before in blocks])


def _kept_in_blocks(
    positions: Float[np.ndarray, "n d"], keep: Keep
) -> Iterator[tuple[int, Bool[np.ndarray, "block n"]]]:
    """Yield the number of the first pair (i, j) and the selected pairs, for blocks of frames i."""
    n = len(positions)
    for start in range(0, n, BLOCK):
        gap = np.arange(start, min(start + BLOCK, n))[:, None] - np.arange(n)[None, :]
        yield start * n, keep(distances(positions[start : start + BLOCK], positions), gap)


def pair_distances(file: DescriptorFile, pairs: Int[np.ndarray, "2 pairs"]) -> Float[np.ndarray, " pairs"]:
    """Return the distance between the descriptors of each pair, by the kind of distance that the file states."""
    if file.distance != "l2":
        return _distances_by_row(file, pairs)
    apart = np.empty(pairs.shape[1])
    for start in range(0, pairs.shape[1], PAIR_BLOCK):
        i, j = pairs[:, start : start + PAIR_BLOCK]
        apart[start : start + PAIR_BLOCK] = np.linalg.norm(file.descriptors[i] - file.descriptors[j], axis=1)
    return apart


def _distances_by_row(file: DescriptorFile, pairs: Int[np.ndarray, "2 pairs"]) -> Float[np.ndarray, " pairs"]:
    """Same as `pair_distances` for distances between sets: each first frame is compared with all its partners."""
    compare, apart = distance_function(file.distance), np.empty(pairs.shape[1])
    order = np.argsort(pairs[0], kind="stable")
    starts = np.flatnonzero(np.diff(pairs[0][order], prepend=-1))
    for of_one in np.split(order, starts[1:]):
        # Partners are repeated up to a multiple of `PARTNERS`, so that a jitted distance compiles for few shapes.
        partners = np.resize(pairs[1, of_one], -(-len(of_one) // PARTNERS) * PARTNERS)
        found = compare(file.descriptors[pairs[0, of_one[:1]]], file.descriptors[partners])
        apart[of_one] = found[0, : len(of_one)]
    return apart


def score_drawn_pairs(
    file: DescriptorFile,
    result: Result,
    positive: Int[np.ndarray, " positives"],
    negative: Int[np.ndarray, " negatives"],
    *,
    seed: int,
) -> Result:
    """Complete `result` with pairs from `frame_pairs`, scored by the descriptors of the file."""
    pairs = np.stack(np.divmod(np.concatenate([positive, negative]), len(file)))
    is_positive = np.arange(pairs.shape[1]) < len(positive)
    scores = -pair_distances(file, pairs) if len(positive) else np.zeros(pairs.shape[1])
    return score_pairs(result, pairs, scores, is_positive, seed=seed)
