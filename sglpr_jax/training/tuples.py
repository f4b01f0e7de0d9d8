"""Draws training tuples: 1 anchor, k_p positives of the same place, k_n negatives of other places; holds out places."""

import dataclasses
from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.spatial import KDTree

from sglpr_jax.methods.recipe import TupleConfig
from sglpr_jax.revisits import close_pairs
from sglpr_jax.training.config import ValidationConfig
from sglpr_jax.training.mining import DescriptorCache


@dataclasses.dataclass(frozen=True)
class Positives:
    """Positives of every frame of the pool, as slices of one flat array."""

    frames: Int[np.ndarray, "pairs"]
    starts: Int[np.ndarray, "bounds"]

    @property
    def anchors(self) -> Int[np.ndarray, "anchors"]:
        """Frames with at least one positive."""
        return np.flatnonzero(np.diff(self.starts))

    def draw(self, rng: np.random.Generator, anchor: int, size: int) -> Int[np.ndarray, "size"]:
        """Draw positives of `anchor`, without repetition if there are enough."""
        choices = self.frames[self.starts[anchor] : self.starts[anchor + 1]]
        return rng.choice(choices, size, replace=len(choices) < size)


class TuplePool:
    """All frames of several recordings, numbered consecutively, and the tuples that can be drawn from them."""

    def __init__(
        self,
        positions: Sequence[Float[np.ndarray, "_ 3"]],
        config: TupleConfig,
        *,
        frames: Sequence[Int[np.ndarray, "_"]] | None = None,
    ):
        """Number the frames and find their positives.

        Arguments:
          positions: Positions of each recording, in metres.
          config: Configuration of the tuples.
          frames: Frames of each recording to use, or None for all.

        Raises:
          ValueError: If no frame has a positive.
        """
        self.config = config
        frames = [np.arange(len(p)) for p in positions] if frames is None else frames
        self.positions = np.concatenate([places[rows] for places, rows in zip(positions, frames, strict=True)])
        self.recording = np.repeat(np.arange(len(positions)), [len(rows) for rows in frames])
        self.frame = np.concatenate(frames)
        pairs = np.concatenate([self._pairs_within(d) for d in range(len(positions))])
        same_visit = np.abs(self.frame[pairs[:, 0]] - self.frame[pairs[:, 1]]) <= config.revisit_gap
        self.neighbours = self._group(pairs[same_visit])
        self.revisits = self._group(pairs[~same_visit])
        if not len(pairs):
            raise ValueError(f"expected frames within {config.positive_m} m of each other as positives, found none")

    def __len__(self) -> int:
        return len(self.frame)

    def draw(
        self, *, seed: int, step: int, tuples: int, cache: DescriptorCache | None = None
    ) -> Int[np.ndarray, "{tuples} k"]:
        """Draw the frame numbers of one batch, with one row (anchor, positives, negatives) per tuple.

        The result is a pure function of the arguments. With a cache, anchors are among its places, and negatives and
        clusters are mined.

        Raises:
          ValueError: If an anchor has no negatives.
        """
        rng = np.random.default_rng([seed, step])
        rows: list[list[int]] = []
        for i in range(tuples):
            cluster = [anchor for anchor, *_ in rows[i - i % self.config.cluster :]]
            rows.append(self._draw_anchored(rng, cluster, cache))
        return np.array([[*row, *self._draw_negatives(rng, row[0], cache)] for row in rows])

    def draw_places(self, *, seed: int, step: int, tuples: int) -> Int[np.ndarray, "{tuples} k"]:
        """Draw the same number of frames as `draw`, but at any places, and without repetition if there are enough."""
        rng = np.random.default_rng([seed, step])
        shape = tuples, 1 + self.config.positives + self.config.negatives
        return rng.choice(len(self), shape, replace=bool(np.prod(shape) > len(self)))

    def _draw_anchored(self, rng: np.random.Generator, cluster: list[int], cache: DescriptorCache | None) -> list[int]:
        """Draw an anchor and its positives. `cluster` contains the earlier anchors of the same cluster."""
        other_visit = rng.random() < self.config.revisit_fraction and len(self.revisits.anchors) > 0
        source = self.revisits if other_visit or not len(self.neighbours.anchors) else self.neighbours
        anchors = source.anchors
        if cache is not None:
            anchors = _unless_empty(np.intersect1d(anchors, cache.places), anchors)
        if cluster and cache is None:
            anchors = _unless_empty(anchors[self._within(cluster[0], anchors, self.config.cluster_m)], anchors)
        elif cluster and cache is not None:  # similar to the first anchor and far from all
            far = self.far_apart(np.array(cluster)[:, None], anchors[None]).all(0)
            anchors = _unless_empty(cache.nearest(cluster[0], anchors[far], self.config.hardest), anchors)
        anchor = int(rng.choice(anchors))
        return [anchor, *source.draw(rng, anchor, self.config.positives).tolist()]

    def _draw_negatives(
        self, rng: np.random.Generator, anchor: int, cache: DescriptorCache | None
    ) -> Int[np.ndarray, "{self.config.negatives}"]:
        choices = np.flatnonzero(self.far_apart(np.array(anchor), np.arange(len(self))))
        size = self.config.negatives
        if size and not len(choices):
            raise ValueError(f"no frame lies farther than {self.config.negative_m} m from frame {anchor} of the pool")
        if cache is not None:
            choices = _unless_empty(cache.nearest(anchor, choices, self.config.hardest), choices)
        return rng.choice(choices, size, replace=len(choices) < size)

    def far_apart(self, a: Int[np.ndarray, "..."], b: Int[np.ndarray, "..."]) -> np.ndarray:
        """Return whether two frames show different places: in different recordings, or beyond the negative distance."""
        return ~self._within(a, b, self.config.negative_m)

    def distances_from_anchors(self, frames: Int[np.ndarray, "t k"]) -> Float[np.ndarray, "t k"]:
        """Return the horizontal distance of each place from the anchor of its tuple, in metres. Infinite between
        recordings."""
        offset = self.positions[frames, :2] - self.positions[frames[:, :1], :2]
        same = self.recording[frames] == self.recording[frames[:, :1]]
        return np.where(same, np.hypot(offset[..., 0], offset[..., 1]), np.inf).astype(np.float32)

    def _within(self, a: Int[np.ndarray, "..."] | int, b: Int[np.ndarray, "..."], metres: float) -> np.ndarray:
        """Whether two frames are in the same recording and at most this distance apart, in metres."""
        offset = self.positions[a, :2] - self.positions[b, :2]
        return (self.recording[a] == self.recording[b]) & (np.hypot(offset[..., 0], offset[..., 1]) <= metres)

    def _pairs_within(self, recording: int) -> Int[np.ndarray, "pairs 2"]:
        members = np.flatnonzero(self.recording == recording)
        pairs = close_pairs(self.positions[members, :2], closer_than_m=self.config.positive_m)
        return members[np.concatenate([pairs, pairs[:, ::-1]])].reshape(-1, 2)

    def _group(self, pairs: Int[np.ndarray, "pairs 2"]) -> Positives:
        pairs = pairs[np.lexsort(pairs.T[::-1])]
        return Positives(pairs[:, 1], np.searchsorted(pairs[:, 0], np.arange(len(self.recording) + 1)))


def _unless_empty(wanted: Int[np.ndarray, "_"], otherwise: Int[np.ndarray, "_"]) -> Int[np.ndarray, "_"]:
    return wanted if len(wanted) else otherwise


def hold_out(
    positions: Float[np.ndarray, "n 3"], config: ValidationConfig, sampling: TupleConfig
) -> tuple[Int[np.ndarray, "training"], Int[np.ndarray, "validation"]]:
    """Split a recording: distant frames for training, and a stretch of frames with all its revisits for validation.

    Every validation frame is within the positive distance of the stretch. Every training frame is beyond the negative
    distance of all validation frames, so that no house is visible in both parts. Both distances are horizontal. The
    stretch is the first one whose fraction of the revisiting frames is nearest to its fraction of all frames.
    """
    n = len(positions)
    length = round(config.share * n)
    if length == 0:
        return np.arange(n), np.arange(0)
    places = positions[:, :2]
    pairs = close_pairs(places, closer_than_m=sampling.positive_m)
    revisits = pairs[np.abs(pairs[:, 0] - pairs[:, 1]) > sampling.revisit_gap]
    revisiting = np.isin(np.arange(n), revisits)
    inside = np.convolve(revisiting, np.ones(length), mode="valid")
    start = int(np.abs(inside - config.share * revisiting.sum()).argmin())
    validation = _within(places, places[start : start + length], np.nextafter(sampling.positive_m, 0))
    near = _within(places, places[validation], sampling.negative_m)
    return np.flatnonzero(~near), np.flatnonzero(validation)


def _within(
    places: Float[np.ndarray, "n 2"], centres: Float[np.ndarray, "m 2"], radius_m: float
) -> Bool[np.ndarray, "n"]:
    """Whether each place is at most this distance from one of the centres, in metres."""
    return KDTree(centres).query(places)[0] <= radius_m
