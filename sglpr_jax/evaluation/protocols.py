"""The protocols: from one descriptor file to a number, each by its own published rule.

The same descriptors score very differently under different protocols, so every result carries its rule and the counts
it rests on. A new protocol is one more function `DescriptorFile -> Result` and one more line in `PROTOCOLS`.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from enum import IntEnum

import numpy as np
from jaxtyping import Bool, Float, Int, Int8

from sglpr_jax import metrics
from sglpr_jax.poses import EXCLUDED_FRAMES, EXCLUDED_S, NEGATIVE_M, POSITIVE_M, database_end, distances, revisits
from sglpr_jax.retrieval.descriptor_file import DescriptorFile

PAIR_GAP = 50
"""Frames no farther apart than so many are neighbours, not a positive pair (SSC, RINet)."""

BEVPLACE_POSITIVE_M = 5.0
BEVPLACE_SPLITS = {"00": (4541, 3000), "02": (4661, 3400), "05": (2761, 1000), "06": (1101, 600), "08": (4071, 1000)}
"""Number of frames of the KITTI sequence, and how many of the first of them are the map."""
BEVPLACE_GAP = 200
"""So many frames between map and queries are neither."""
MAP_SHARE = 0.6
"""The part of any other sequence that is the map."""

BLOCK = 512
"""Queries compared with the whole database at a time."""
PAIR_BLOCK = 1 << 14
"""Pairs compared at a time."""


class Decision(IntEnum):
    """What became of one frame as a query, at the threshold of F1max."""

    NOT_A_QUERY = 0
    TRUE_POSITIVE = 1
    FALSE_POSITIVE = 2
    FALSE_NEGATIVE = 3
    TRUE_NEGATIVE = 4
    UNCOUNTED = 5
    """A query that the protocol counts for nothing, such as one answered with a frame 3 to 20 m away."""


@dataclass(frozen=True, eq=False)
class Result:
    """One protocol's number for one descriptor file, with all that says what the number is."""

    name: str
    rule: str
    """The protocol in words, with its distances."""
    counts: dict[str, int]
    """What the score rests on: queries and revisits, or pairs."""
    dimensions: int
    """2: distances in x and y. 3: in x, y and z."""
    pose_source: str | None
    score: float = np.nan
    """NaN where the sequence has no revisit, so that there is nothing to find."""
    curve: metrics.PrecisionRecallCurve | None = None
    """Its thresholds are negated descriptor distances. None for a recall, and where there is no revisit."""
    decisions: np.ndarray | None = None
    """(n,) int8: a `Decision` for every frame. None for pairs."""


def top1_f1max(file: DescriptorFile) -> Result:
    """Score top-1 retrieval as LoGG3D-Net and Locus do: 3 m / 20 m in 3-D, the last 30 s excluded.

    Each query is answered with the nearest descriptor among the frames at least 30 s older (`poses.database_end` has
    the rule). Accepted, the answer is a true positive up to 3 m away, a false positive beyond 20 m, and counts for
    nothing in between. Rejected, it is a false negative if the query has any frame within 3 m in its database, else a
    true negative. Every distinct distance is a threshold.
    """
    positions = _positions(file)
    ends = database_end(len(file), times=file.times)
    queries = np.flatnonzero(ends)
    revisited = revisits(positions, times=file.times)[queries]
    decisions = np.full(len(file), Decision.NOT_A_QUERY, dtype=np.int8)
    decisions[queries] = Decision.TRUE_NEGATIVE
    excluded = f"{EXCLUDED_FRAMES} frames" if file.times is None else f"{EXCLUDED_S:g} s"
    result = Result(
        name="top-1 F1max",
        rule=f"{POSITIVE_M:g} m / {NEGATIVE_M:g} m, last {excluded} excluded",
        counts={"queries": len(queries), "revisits": int(revisited.sum())},
        dimensions=3,
        pose_source=file.pose_source,
        decisions=decisions,
    )
    if not revisited.any():
        return result
    nearest, distance = _nearest_descriptors(file.descriptors[queries], file.descriptors, ends[queries])
    apart = np.linalg.norm(positions[queries] - positions[nearest], axis=1)
    right, wrong = apart <= POSITIVE_M, apart > NEGATIVE_M
    curve = metrics.decision_curve(
        -distance, true_if_accepted=right, false_if_accepted=wrong, missed_if_rejected=revisited
    )
    accepted = -distance >= curve.thresholds[curve.best]
    decisions[queries] = _decide(accepted, right=right, wrong=wrong, revisited=revisited)
    return replace(result, score=curve.f1_max, curve=curve, decisions=decisions)


def pairs_f1max(file: DescriptorFile, *, negatives_per_positive: int = 100, seed: int = 0) -> Result:
    """Score pairs of frames as SSC and RINet do (`neg_100`): 3 m / 20 m in x and y, 100 negatives per positive.

    Positive: every pair less than 3 m and more than 50 frames apart. Negative: pairs more than 20 m apart, drawn
    without replacement, or all of them where there are not enough. The lists published were drawn from an unknown seed;
    another seed moves the score by .001 to .004.
    """
    rng = np.random.default_rng(seed)
    pairs, positive = _draw_pairs(_positions(file)[:, :2], negatives_per_positive, rng)
    result = Result(
        name="pairs F1max",
        rule=f"{POSITIVE_M:g} m / {NEGATIVE_M:g} m, {negatives_per_positive} negatives per positive, seed {seed}",
        counts={"positive pairs": int(positive.sum()), "negative pairs": int((~positive).sum())},
        dimensions=2,
        pose_source=file.pose_source,
    )
    if not positive.any():
        return result
    curve = metrics.classification_curve(-_pair_distances(file.descriptors, pairs), positive)
    return replace(result, score=curve.f1_max, curve=curve)


def bevplace_recall_at_1(file: DescriptorFile) -> Result:
    """Score Recall@1 on BEVPlace++'s split: the first part of the sequence is the map, 5 m in 3-D.

    A query counts if the map has a frame less than 5 m away; it is found if the nearest descriptor is such a frame. The
    split is the published one where name and number of frames are those of a KITTI sequence that has one. Elsewhere the
    map is the first 60 % of the frames and the rest are queries, without a gap between them.
    """
    positions = _positions(file)
    map_end, first, split = _bevplace_split(file.sequence, len(file))
    queries = np.arange(first, len(file))
    close = distances(positions[queries], positions[:map_end]) < BEVPLACE_POSITIVE_M
    revisited = close.any(axis=1)
    decisions = np.full(len(file), Decision.NOT_A_QUERY, dtype=np.int8)
    decisions[queries] = Decision.UNCOUNTED
    result = Result(
        name="Recall@1",
        rule=f"{BEVPLACE_POSITIVE_M:g} m, {split}",
        counts={"queries": len(queries), "revisits": int(revisited.sum())},
        dimensions=3,
        pose_source=file.pose_source,
        decisions=decisions,
    )
    if not revisited.any():
        return result
    nearest, _ = _nearest_descriptors(file.descriptors[queries], file.descriptors, np.full(len(queries), map_end))
    found = close[np.arange(len(queries)), nearest][revisited]
    decisions[queries[revisited]] = np.where(found, Decision.TRUE_POSITIVE, Decision.FALSE_NEGATIVE)
    return replace(result, score=float(found.mean()), decisions=decisions)


PROTOCOLS: dict[str, Callable[[DescriptorFile], Result]] = {
    "top1-f1max": top1_f1max,
    "pairs-f1max": pairs_f1max,
    "bevplace-recall-at-1": bevplace_recall_at_1,
}
"""Every protocol by the name a command line takes."""


def _positions(file: DescriptorFile) -> Float[np.ndarray, "n 3"]:
    """Return the file's positions; ValueError where it has none."""
    if file.positions is None:
        raise ValueError(f"expected positions to score sequence {file.sequence} against, found none")
    return file.positions


def _bevplace_split(sequence: str, n: int) -> tuple[int, int, str]:
    """Return how many frames are the map, the first query, and the split in words."""
    frames, map_end = BEVPLACE_SPLITS.get(sequence, (None, 0))
    if frames == n:
        first = map_end + BEVPLACE_GAP
        return map_end, first, f"BEVPlace++ split: map 0 to {map_end - 1}, queries {first} to {n - 1}"
    map_end = int(MAP_SHARE * n)
    return map_end, map_end, f"no published split: map is the first {MAP_SHARE:.0%} of the frames"


def _nearest_descriptors(
    queries: Float[np.ndarray, "q d"], database: Float[np.ndarray, "n d"], ends: Int[np.ndarray, " q"]
) -> tuple[Int[np.ndarray, " q"], Float[np.ndarray, " q"]]:
    """Return for each query the nearest of the first `ends` >= 1 descriptors, and its distance."""
    norms = np.sum(database**2, axis=1)
    nearest = np.zeros(len(queries), dtype=np.int64)
    for start in range(0, len(queries), BLOCK):
        rows = slice(start, start + BLOCK)
        # |q - d|^2 without |q|^2, which is the same for the whole row.
        ranking = norms[None, :] - 2 * queries[rows] @ database.T
        ranking[np.arange(len(database)) >= ends[rows, None]] = np.inf
        nearest[rows] = np.argmin(ranking, axis=1)
    return nearest, np.linalg.norm(queries - database[nearest], axis=1).astype(np.float64)


def _draw_pairs(
    positions: Float[np.ndarray, "n 2"], negatives_per_positive: int, rng: np.random.Generator
) -> tuple[Int[np.ndarray, "2 pairs"], Bool[np.ndarray, " pairs"]]:
    """Return pairs of frames (later, earlier): every positive one, then the negatives drawn; and which are positive."""
    n = len(positions)
    positive, negative = [], []
    for start in range(0, n, BLOCK):
        later, earlier = np.arange(start, min(start + BLOCK, n))[:, None], np.arange(n)[None, :]
        apart = distances(positions[start : start + BLOCK], positions)
        positive.append(start * n + np.flatnonzero((apart < POSITIVE_M) & (later - earlier > PAIR_GAP)))
        negative.append(start * n + np.flatnonzero((apart > NEGATIVE_M) & (later > earlier)))
    positive, negative = np.concatenate(positive), np.concatenate(negative)
    drawn = rng.choice(negative, min(negatives_per_positive * len(positive), len(negative)), replace=False)
    pairs = np.stack(np.divmod(np.concatenate([positive, drawn]), n))
    return pairs, np.arange(pairs.shape[1]) < len(positive)


def _pair_distances(
    descriptors: Float[np.ndarray, "n d"], pairs: Int[np.ndarray, "2 pairs"]
) -> Float[np.ndarray, " pairs"]:
    """Return the distance between the descriptors of each pair, a block at a time: the gathered rows would be large."""
    blocks = (pairs[:, start : start + PAIR_BLOCK] for start in range(0, pairs.shape[1], PAIR_BLOCK))
    return np.concatenate(
        [np.linalg.norm(descriptors[later] - descriptors[earlier], axis=1) for later, earlier in blocks]
    ).astype(np.float64)


def _decide(
    accepted: Bool[np.ndarray, " q"],
    *,
    right: Bool[np.ndarray, " q"],
    wrong: Bool[np.ndarray, " q"],
    revisited: Bool[np.ndarray, " q"],
) -> Int8[np.ndarray, " q"]:
    """Return the `Decision` for each query."""
    return np.select(
        [accepted & right, accepted & wrong, accepted, revisited],
        [Decision.TRUE_POSITIVE, Decision.FALSE_POSITIVE, Decision.UNCOUNTED, Decision.FALSE_NEGATIVE],
        Decision.TRUE_NEGATIVE,
    ).astype(np.int8)
