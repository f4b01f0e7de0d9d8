"""Which frames make a training tuple: 1 anchor, k_p positives of the same place, k_n negatives of other places."""

import dataclasses
from collections.abc import Sequence as Many

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial import KDTree

from sglpr_jax.poses import NEGATIVE_M, POSITIVE_M


@dataclasses.dataclass(frozen=True)
class TupleConfig:
    """How tuples are drawn. Distances are horizontal: ground-truth heights drift by metres within a drive."""

    positives: int = 1
    negatives: int = 10
    positive_m: float = POSITIVE_M
    negative_m: float = NEGATIVE_M
    revisit_fraction: float = 0.5
    """The share of tuples whose positives come from another visit; the others' come from neighbouring frames."""
    revisit_gap: int = 50
    """Frames at most this far apart belong to one visit."""
    cluster: int = 1
    """Tuples in a row whose anchors lie near each other. Where tuples share their places as negatives, neighbouring
    places of one street are harder to tell apart than any two of a whole drive."""
    cluster_m: float = 100.0
    """How near: the distance to the first anchor of the row."""


@dataclasses.dataclass(frozen=True)
class Positives:
    """For every frame of the pool its positives, as slices of one flat array."""

    frames: Int[np.ndarray, "pairs"]
    starts: Int[np.ndarray, "bounds"]

    @property
    def anchors(self) -> Int[np.ndarray, "anchors"]:
        """The frames that have a positive at all."""
        return np.flatnonzero(np.diff(self.starts))

    def draw(self, rng: np.random.Generator, anchor: int, size: int) -> Int[np.ndarray, "size"]:
        """Some positives of `anchor`; all different where there are enough."""
        choices = self.frames[self.starts[anchor] : self.starts[anchor + 1]]
        return rng.choice(choices, size, replace=len(choices) < size)


class TuplePool:
    """All frames of several drives, counted through, and the tuples that can be drawn from them."""

    def __init__(self, positions: Many[Float[np.ndarray, "_ 3"]], config: TupleConfig):
        """Raises ValueError when no frame has a positive."""
        self.config = config
        self.positions = np.concatenate(positions)
        self.drive = np.repeat(np.arange(len(positions)), [len(p) for p in positions])
        self.frame = np.concatenate([np.arange(len(p)) for p in positions])
        pairs = np.concatenate([self._pairs_within(d) for d in range(len(positions))])
        same_visit = np.abs(pairs[:, 0] - pairs[:, 1]) <= config.revisit_gap
        self.neighbours = self._group(pairs[same_visit])
        self.revisits = self._group(pairs[~same_visit])
        if not len(pairs):
            raise ValueError(f"no two frames lie within {config.positive_m} m of each other: nothing can be a positive")

    def draw(self, *, seed: int, step: int, tuples: int) -> Int[np.ndarray, "{tuples} k"]:
        """The pool's frame numbers of one batch, (anchor, positives, negatives) a row. A pure function.

        Raises ValueError for an anchor that has no negatives.
        """
        rng = np.random.default_rng([seed, step])
        anchored: list[list[int]] = []
        for i in range(tuples):
            first = anchored[i - i % self.config.cluster][0] if i % self.config.cluster else None
            anchored.append(self._draw_anchored(rng, near=first))
        return np.array([[*row, *self._draw_negatives(rng, row[0])] for row in anchored])

    def _draw_anchored(self, rng: np.random.Generator, *, near: int | None) -> list[int]:
        other_visit = rng.random() < self.config.revisit_fraction and len(self.revisits.anchors) > 0
        source = self.revisits if other_visit or not len(self.neighbours.anchors) else self.neighbours
        anchors = source.anchors
        if near is not None:
            around = anchors[self._within(near, anchors, self.config.cluster_m)]
            anchors = around if len(around) else anchors
        anchor = int(rng.choice(anchors))
        return [anchor, *source.draw(rng, anchor, self.config.positives).tolist()]

    def _draw_negatives(self, rng: np.random.Generator, anchor: int) -> Int[np.ndarray, "{self.config.negatives}"]:
        choices = np.flatnonzero(self.far_apart(np.array(anchor), np.arange(len(self.drive))))
        size = self.config.negatives
        if size and not len(choices):
            raise ValueError(f"no frame lies farther than {self.config.negative_m} m from frame {anchor} of the pool")
        return rng.choice(choices, size, replace=len(choices) < size)

    def far_apart(self, a: Int[np.ndarray, "..."], b: Int[np.ndarray, "..."]) -> np.ndarray:
        """Whether two frames are certainly other places: of other drives, or beyond the negative distance."""
        return ~self._within(a, b, self.config.negative_m)

    def _within(self, a: Int[np.ndarray, "..."] | int, b: Int[np.ndarray, "..."], metres: float) -> np.ndarray:
        """Whether two frames are of one drive and at most so far apart."""
        offset = self.positions[a, :2] - self.positions[b, :2]
        return (self.drive[a] == self.drive[b]) & (np.hypot(offset[..., 0], offset[..., 1]) <= metres)

    def _pairs_within(self, drive: int) -> Int[np.ndarray, "pairs 2"]:
        members = np.flatnonzero(self.drive == drive)
        tree = KDTree(self.positions[members, :2])
        pairs = tree.query_pairs(np.nextafter(self.config.positive_m, 0), output_type="ndarray")
        return members[np.concatenate([pairs, pairs[:, ::-1]])].reshape(-1, 2)

    def _group(self, pairs: Int[np.ndarray, "pairs 2"]) -> Positives:
        pairs = pairs[np.lexsort(pairs.T[::-1])]
        return Positives(pairs[:, 1], np.searchsorted(pairs[:, 0], np.arange(len(self.drive) + 1)))
