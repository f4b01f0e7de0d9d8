"""Training tuples: an anchor, k_p positives near it and k_n negatives far from it. Held-out parts of recordings."""

import dataclasses
import functools
from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.spatial import KDTree

from sglpr_jax.data.recording import Recording
from sglpr_jax.methods.recipe import TupleConfig
from sglpr_jax.revisits import close_pairs
from sglpr_jax.training.config import TrainConfig, ValidationConfig
from sglpr_jax.training.mining import DescriptorCache

WORLDS_APART_M = 1e9
"""Distance between places of different worlds, in metres. No place on Earth is as far."""


@dataclasses.dataclass(frozen=True)
class Positives:
    """Positives of all places of a pool. Those of place i are `places[starts[i] : starts[i + 1]]`."""

    places: Int[np.ndarray, "pairs"]
    starts: Int[np.ndarray, "bounds"]

    @functools.cached_property
    def anchors(self) -> Int[np.ndarray, "anchors"]:
        """Places with at least one positive."""
        return self.anchors_among(np.arange(len(self.starts) - 1))

    def anchors_among(self, places: Int[np.ndarray, "_"]) -> Int[np.ndarray, "_"]:
        """Return those of the places that have at least one positive."""
        return places[self.starts[places] < self.starts[places + 1]]

    def draw(self, rng: np.random.Generator, anchor: int, size: int) -> Int[np.ndarray, "size"]:
        """Draw positives of `anchor`, without repetition if there are enough."""
        positives = self.places[self.starts[anchor] : self.starts[anchor + 1]]
        return rng.choice(positives, size, replace=len(positives) < size)


class TuplePool:
    """The places of a training, and the tuples that can be drawn from them.

    Every frame of several recordings is one place. Places are numbered from 0, recording after recording. Place i is
    frame `frame_of[i]` of recording `recording_of[i]`, at `positions[i]` in metres in the frame of world `world_of[i]`.
    Recordings of one world, such as drives of several days or sensors, have positives in each other.
    """

    def __init__(
        self,
        positions: Sequence[Float[np.ndarray, "_ 3"]],
        config: TupleConfig,
        *,
        frames: Sequence[Int[np.ndarray, "_"]] | None = None,
        worlds: Sequence[int] | None = None,
    ):
        """Number the places and find their positives. Raises ValueError if no place has a positive.

        Arguments:
          positions: Positions of each recording, in metres.
          config: Choice of the tuples.
          frames: Frames to use of each recording, by default all.
          worlds: Number of the world of each recording (`worlds_of`), by default one for each.
        """
        self.config = config
        frames = [np.arange(len(recording)) for recording in positions] if frames is None else frames
        self.positions = np.concatenate([recording[rows] for recording, rows in zip(positions, frames, strict=True)])
        self.recording_of = np.repeat(np.arange(len(positions)), [len(rows) for rows in frames])
        self.frame_of = np.concatenate(frames)
        self.world_of = self.recording_of if worlds is None else np.asarray(worlds)[self.recording_of]
        self.separated = np.column_stack([self.positions[:, :2], WORLDS_APART_M * self.world_of])
        """Coordinates (n, 3) in metres: horizontal position, and one that puts worlds `WORLDS_APART_M` apart."""
        pairs = close_pairs(self.separated, closer_than_m=config.positive_m)
        self.visit_end = visit_ends(pairs, self.recording_of, self.frame_of, gap=config.revisit_gap)
        """Last place of the visit that each place belongs to (`visit_ends`)."""
        pairs = np.concatenate([pairs, pairs[:, ::-1]])  # (anchor, positive), in both orders
        same_visit = self.are_of_one_visit(*pairs.T)
        self.neighbours = self._positives_by_anchor(pairs[same_visit])
        self.revisits = self._positives_by_anchor(pairs[~same_visit])
        if not len(pairs):
            raise ValueError(f"expected frames within {config.positive_m} m of each other as positives, found none")

    def __len__(self) -> int:
        return len(self.frame_of)

    @property
    def has_negatives(self) -> bool:
        """Whether any place is far enough from another one to be its negative."""
        places = np.arange(len(self))
        return any(self.far_apart(places[place], places).any() for place in places)

    def draw(
        self, *, seed: int, step: int, tuples: int, cache: DescriptorCache | None = None
    ) -> Int[np.ndarray, "{tuples} k"]:
        """Draw the place numbers of one batch, with one row (anchor, positives, negatives) per tuple.

        The result is a pure function of the arguments. With a cache, anchors are among its places, and negatives and
        the anchors of a cluster have similar descriptors. Raises ValueError if an anchor has no negatives.
        """
        rng = np.random.default_rng([seed, step])
        anchors_and_positives: list[list[int]] = []
        for i in range(tuples):
            cluster_start = i - i % self.config.cluster
            cluster = [anchor for anchor, *_ in anchors_and_positives[cluster_start:]]
            anchors_and_positives.append(self._draw_anchor_and_positives(rng, cluster, cache))
        return np.array([[*row, *self._draw_negatives(rng, row[0], cache)] for row in anchors_and_positives])

    def draw_places(self, *, seed: int, step: int, tuples: int) -> Int[np.ndarray, "{tuples} k"]:
        """Draw random places in the shape of `draw`. They repeat only if the pool has fewer places."""
        rng = np.random.default_rng([seed, step])
        shape = tuples, 1 + self.config.positives + self.config.negatives
        return rng.choice(len(self), shape, replace=bool(np.prod(shape) > len(self)))

    def _draw_anchor_and_positives(
        self, rng: np.random.Generator, cluster: list[int], cache: DescriptorCache | None
    ) -> list[int]:
        """Draw an anchor and its positives, either of other visits or of the same visit (`config.revisit_fraction`).

        `cluster` contains the earlier anchors of the same cluster. The new anchor is near the first of them or, with a
        cache of descriptors, similar to the first and far from all.
        """
        wants_revisit = rng.random() < self.config.revisit_fraction
        prefers_revisits = wants_revisit and len(self.revisits.anchors) > 0
        source = self.revisits if prefers_revisits or not len(self.neighbours.anchors) else self.neighbours
        anchors = source.anchors
        if cache is not None:
            anchors = _first_unless_empty(source.anchors_among(cache.places), anchors)
        if cluster and cache is None:
            near_cluster = anchors[self._are_within(cluster[0], anchors, self.config.cluster_m)]
            anchors = _first_unless_empty(near_cluster, anchors)
        elif cluster and cache is not None:
            far_from_cluster = anchors[self.far_apart(np.array(cluster)[:, None], anchors[None]).all(0)]
            similar_to_first = cache.nearest(cluster[0], far_from_cluster, self.config.hardest)
            anchors = _first_unless_empty(similar_to_first, anchors)
        anchor = int(rng.choice(anchors))
        return [anchor, *source.draw(rng, anchor, self.config.positives).tolist()]

    def _draw_negatives(
        self, rng: np.random.Generator, anchor: int, cache: DescriptorCache | None
    ) -> Int[np.ndarray, "{self.config.negatives}"]:
        """Draw places far from the anchor. With a cache, only those whose descriptors are most similar to its own."""
        size = self.config.negatives
        if not size:
            return np.arange(0)
        candidates = np.arange(0)
        if cache is not None:
            candidates = cache.nearest(anchor, self._far_from(anchor, cache.places), self.config.hardest)
        if not len(candidates):
            candidates = self._far_from(anchor, np.arange(len(self)))
        if not len(candidates):
            raise ValueError(f"no frame lies farther than {self.config.negative_m} m from frame {anchor} of the pool")
        return rng.choice(candidates, size, replace=len(candidates) < size)

    def _far_from(self, anchor: int, places: Int[np.ndarray, "_"]) -> Int[np.ndarray, "_"]:
        return places[self.far_apart(np.array(anchor), places)]

    def far_apart(self, a: Int[np.ndarray, "..."], b: Int[np.ndarray, "..."]) -> np.ndarray:
        """Return whether places a and b are in different worlds or farther apart than the negative distance."""
        return ~self._are_within(a, b, self.config.negative_m)

    def are_of_one_visit(self, a: Int[np.ndarray, "..."], b: Int[np.ndarray, "..."]) -> np.ndarray:
        """Return whether the later of places a and b is in the visit of the earlier one."""
        return np.maximum(a, b) <= self.visit_end[np.minimum(a, b)]

    def distances_from_anchors(self, places: Int[np.ndarray, "t k"]) -> Float[np.ndarray, "t k"]:
        """Return the horizontal distance of each place from its anchor, in metres. Infinite between worlds."""
        distances_m = self._distances(places, places[:, :1])
        return np.where(distances_m < WORLDS_APART_M / 2, distances_m, np.inf).astype(np.float32)

    def _distances(self, a: Int[np.ndarray, "..."] | int, b: Int[np.ndarray, "..."]) -> Float[np.ndarray, "..."]:
        """Return the horizontal distances of places a and b in metres, or `WORLDS_APART_M` and more between worlds."""
        return np.linalg.norm(self.separated[a] - self.separated[b], axis=-1)

    def _are_within(self, a: Int[np.ndarray, "..."] | int, b: Int[np.ndarray, "..."], max_m: float) -> np.ndarray:
        """Return whether places a and b are in one world and at most this horizontal distance apart, in metres."""
        return self._distances(a, b) <= max_m

    def _positives_by_anchor(self, pairs: Int[np.ndarray, "pairs 2"]) -> Positives:
        """Group pairs (anchor, positive) by anchor."""
        pairs = pairs[np.lexsort(pairs.T[::-1])]  # by anchor, then by positive
        return Positives(pairs[:, 1], np.searchsorted(pairs[:, 0], np.arange(len(self) + 1)))


def visit_ends(
    pairs: Int[np.ndarray, "pairs 2"],
    recording_of: Int[np.ndarray, "n"],
    frame_of: Int[np.ndarray, "n"],
    *,
    gap: int,
) -> Int[np.ndarray, "n"]:
    """Return the last place of the visit at each place: `gap` frames later, or the last place before the sensor is away
    for `gap` frames. A vehicle at a traffic light does not visit the place again and again.

    Arguments:
      pairs: All pairs of places within the positive distance, the earlier place first.
      recording_of: Recording of each place, in order.
      frame_of: Frame of each place, in order within its recording.
      gap: Minimum length of a visit, and of the absence that ends it, in frames.
    """
    pairs = pairs[np.lexsort(pairs.T[::-1])]
    first, later = pairs.T
    clock = recording_of * (frame_of.max(initial=0) + gap + 1) + frame_of
    before = np.where(np.diff(first, prepend=-1) != 0, first, np.roll(later, 1))  # the near place before the later one
    is_return = clock[later] - clock[before] > gap
    returns, start = np.cumsum(is_return), np.searchsorted(first, first)
    stays = returns == returns[start] - is_return[start]  # no return since the first place
    ends = np.searchsorted(clock, clock + gap, side="right") - 1
    np.maximum.at(ends, first[stays], later[stays])
    return ends


def _first_unless_empty(preferred: Int[np.ndarray, "_"], fallback: Int[np.ndarray, "_"]) -> Int[np.ndarray, "_"]:
    return preferred if len(preferred) else fallback


def tuple_pool(
    recordings: Sequence[Recording], config: TupleConfig, *, frames: Sequence[Int[np.ndarray, "_"]] | None = None
) -> TuplePool:
    """Return the pool of all frames, or of the `frames` of each recording. Raises ValueError without positives."""
    positions = [positions_of(recording) for recording in recordings]
    return TuplePool(positions, config, frames=frames, worlds=worlds_of(recordings))


def worlds_of(recordings: Sequence[Recording]) -> list[int]:
    """Return the number of each recording's world, from 0. A recording without one (`Recording.world`) has its own."""
    names = [recording.world or number for number, recording in enumerate(recordings)]
    numbers = {name: number for number, name in enumerate(dict.fromkeys(names))}
    return [numbers[name] for name in names]


def split_recordings(
    recordings: Sequence[Recording], config: TrainConfig
) -> list[tuple[Int[np.ndarray, "training"], Int[np.ndarray, "validation"]]]:
    """Return the frames of each recording for training and for validation (`hold_out`, for each world)."""
    splits, worlds = {}, np.array(worlds_of(recordings))
    for world in range(worlds.max() + 1):
        rows = np.flatnonzero(worlds == world).tolist()
        positions = [positions_of(recordings[row]) for row in rows]
        splits |= zip(rows, hold_out(positions, config.validation, config.sampling), strict=True)
    return [splits[row] for row in range(len(recordings))]


def positions_of(recording: Recording) -> Float[np.ndarray, "n 3"]:
    """Return the positions of a recording, in metres. Raises ValueError if it has none."""
    if recording.positions is None:
        raise ValueError(f"sequence {recording.name} has no poses; training and scoring need them")
    return recording.positions


def hold_out(
    positions: Sequence[Float[np.ndarray, "_ 3"]], config: ValidationConfig, sampling: TupleConfig
) -> list[tuple[Int[np.ndarray, "training"], Int[np.ndarray, "validation"]]]:
    """Split the recordings of a world: distant frames for training, and for validation those at a stretch of the first.

    Every validation frame is within the positive distance of the stretch. Every training frame is beyond the negative
    distance of all validation frames, so that no house is visible in both parts. Both distances are horizontal. The
    stretch is the first one whose fraction of the revisiting frames is nearest to its fraction of all frames.

    Returns the frames for training and for validation of each recording.
    """
    stretch = _stretch(positions[0][:, :2], config, sampling)
    if not len(stretch):
        return [(np.arange(len(recording)), np.arange(0)) for recording in positions]
    planes = [recording[:, :2] for recording in positions]
    below_positive_m = np.nextafter(sampling.positive_m, 0)  # as `close_pairs`, which excludes the distance itself
    validation = [_is_near(plane, stretch, below_positive_m) for plane in planes]
    held_out = np.concatenate([plane[rows] for plane, rows in zip(planes, validation, strict=True)])
    return [
        (np.flatnonzero(~_is_near(plane, held_out, sampling.negative_m)), np.flatnonzero(rows))
        for plane, rows in zip(planes, validation, strict=True)
    ]


def _stretch(
    plane: Float[np.ndarray, "n 2"], config: ValidationConfig, sampling: TupleConfig
) -> Float[np.ndarray, "_ 2"]:
    """Return the positions of the stretch of a recording for `hold_out`."""
    frames = np.arange(len(plane))
    stretch_length = round(config.share * len(frames))
    if stretch_length == 0:
        return plane[:0]
    pairs = close_pairs(plane, closer_than_m=sampling.positive_m)
    ends = visit_ends(pairs, np.zeros_like(frames), frames, gap=sampling.revisit_gap)
    is_revisiting = np.isin(frames, pairs[pairs[:, 1] > ends[pairs[:, 0]]])
    revisiting_by_start = np.convolve(is_revisiting, np.ones(stretch_length), mode="valid")
    start = int(np.abs(revisiting_by_start - config.share * is_revisiting.sum()).argmin())
    return plane[start : start + stretch_length]


def _is_near(
    positions: Float[np.ndarray, "n 2"], centres: Float[np.ndarray, "m 2"], radius_m: float
) -> Bool[np.ndarray, "n"]:
    """Return whether each position is at most this distance from one of the centres, in metres."""
    return KDTree(centres).query(positions)[0] <= radius_m
