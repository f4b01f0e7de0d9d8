"""Batches of training tuples: read from files on the host, rotated and rasterised on the device.

A batch may mix two sources, such as real images without labels and simulated scans with labels. The segmentation head
sees every n-th image of the network's order, so labelled places of a second source are put there. The head then spends
no time on images without labels.
"""

import dataclasses
import functools
from collections.abc import Callable, Sequence
from typing import Any

import flax.struct
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, Shaped

from sglpr_jax.data.recording import Recording
from sglpr_jax.data.scan import check_cloud
from sglpr_jax.data.views import View, check_ready_made, cloud_view, image_view, picture
from sglpr_jax.grid import Grid, ImageKind
from sglpr_jax.labels import UNLABELLED
from sglpr_jax.training.batch_queue import BatchSource
from sglpr_jax.training.config import TrainConfig
from sglpr_jax.training.devices import own_part
from sglpr_jax.training.mining import Mining
from sglpr_jax.training.step import TrainState
from sglpr_jax.training.tuples import TuplePool

Place = tuple[Any, Any]
"""Data of one place: an image (h, w) or points (n, 3), and their classes (h, w) or (n,), or None."""


@flax.struct.dataclass
class Batch:
    """Training tuples as arrays: t tuples of k = 1 + k_p + k_n places, flattened to b = t k places.

    A batch has either `images` with `maps`, or `points` with `count` and `classes`. If no recording has
    labels, `maps` and `classes` stay None.
    """

    labelled: Any
    """Whether each place has labels (b,), including the places of `also`."""
    negatives: Any
    """Whether each place is a negative of each anchor (t, b). Covers `also`, unless the triplet loss ignores it."""
    positives: int = flax.struct.field(pytree_node=False)
    """Number of positives after each anchor."""
    images: Any = None
    """Images (b, h, w)."""
    maps: Any = None
    """Classes of the pixels (b, h, w)."""
    points: Any = None
    """Padded points (b, n, 3)."""
    count: Any = None
    """Number of valid points of each place (b,)."""
    classes: Any = None
    """Classes of the points (b, n)."""
    also: Any = None
    """Second batch, whose places follow the places of this batch."""

    @property
    def places(self) -> int:
        """Number of places, without those of `also`."""
        return len(self.points if self.images is None else self.images)


def read_batch(
    recordings: Sequence[Recording],
    pool: TuplePool,
    frames: Int[np.ndarray, "t k"],
    *,
    max_points: int,
    share_negatives: bool,
    categories: int = 20,
    image: ImageKind = "points",
    part: slice = slice(None),
) -> Batch:
    """Read the frames of some tuples.

    Arguments:
      recordings: Recordings of the pool.
      pool: Pool of the frames.
      frames: Frame numbers of the pool, one row per tuple, from `TuplePool.draw`.
      max_points: Maximum number of points of a cloud. Larger clouds are thinned evenly.
      share_negatives: Whether every place of the batch that is far enough from an anchor is its negative. Otherwise
        only the negatives of its own tuple count.
      categories: Number of classes; with 0 no labels are read.
      image: Kind of image. "density" computes density images from all points of a scan.
      part: Tuples to read. Their negatives come from the whole batch.

    Raises:
      ValueError: If the batch mixes scans and images, images differ in size, or a scan shows no place.
    """
    tuples, size = frames.shape
    negatives = pool.far_apart(frames[:, :1], frames.reshape(1, -1))
    if not share_negatives:
        negatives &= np.kron(np.eye(tuples, dtype=bool), np.arange(size) > pool.config.positives)
    has_labels = categories > 0 and any(recording.has_labels for recording in recordings)
    images = recordings[0].has_images
    places = [(recordings[int(pool.recording[f])], int(pool.frame[f])) for f in frames[part].reshape(-1)]
    pictures = images or image == "density"

    def read(recording: Recording, frame: int) -> Place:
        if recording.has_images != images:
            expected, found = ("images", "scans") if images else ("scans", "images")
            raise ValueError(f"expected only {expected} in a batch, found {found} in recording {recording.name}")
        scan = recording.scan(frame, labels=has_labels)
        if scan.points is not None:
            check_cloud(scan.points, name=scan.name)
        check_ready_made(scan, image)
        classes = scan.classes(categories) if has_labels else None
        return picture(scan, classes) if pictures else (scan.upright_points, classes)

    found = [read(*place) for place in places]
    labelled = np.array([classes is not None for _, classes in found])
    common = {"labelled": labelled, "negatives": negatives[part], "positives": pool.config.positives}
    if pictures:
        _require_one_size(places, found)
        stacked, maps = np.stack([one for one, _ in found]), None
        if has_labels:
            maps = np.stack(
                [np.full(one.shape, UNLABELLED, np.int32) if kinds is None else kinds for one, kinds in found]
            )
        return Batch(**common, images=stacked, maps=maps)
    points, count, classes = _padded(found, max_points)
    return Batch(**common, points=points, count=count, classes=classes if has_labels else None)


def views(batch: Batch, angles: Float[Array, "b"] | None, grid: Grid) -> View:
    """Return the model input of each place, inside jit on the device.

    Arguments:
      batch: Places to convert.
      angles: Rotation angle of each place in radians, or None.
      grid: Grid of the model.

    Returns:
      Images, and maps of classes or None if no place has labels.
    """
    if batch.also is None and batch.images is not None:
        return image_view(batch.images, batch.maps, grid, angles)
    if batch.also is None:
        return cloud_view(batch.points, batch.classes, batch.count, grid, angles)
    own, others = (None, None) if angles is None else (angles[: batch.places], angles[batch.places :])
    parts = [views(dataclasses.replace(batch, also=None), own, grid), views(batch.also, others, grid)]
    images = jnp.concatenate([image for image, _ in parts])
    if all(maps is None for _, maps in parts):
        return View(images)
    unlabelled = [jnp.full(image.shape, UNLABELLED) if maps is None else maps for image, maps in parts]
    return View(images, jnp.concatenate(unlabelled))


def _require_one_size(places: list[tuple[Recording, int]], pictures: list[Place]) -> None:
    expected = pictures[0][0].shape
    for (recording, frame), (image, _) in zip(places, pictures, strict=True):
        if image.shape != expected:
            raise ValueError(
                f"recording {recording.name}, frame {recording.ids[frame]}: expected an image of {expected[0]} x"
                f" {expected[1]} pixels, as in {places[0][0].name}, found {image.shape[0]} x {image.shape[1]}"
            )


def _padded(scans: list[Place], max_points: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Pad clouds to one size. Returns points, numbers of valid points, and classes (0 without labels)."""
    points = np.zeros((len(scans), max_points, 3), np.float32)
    classes = np.zeros((len(scans), max_points), np.int32)
    count = np.zeros(len(scans), np.int32)
    for row, (cloud, cloud_classes) in enumerate(scans):
        kept = slice(None) if len(cloud) <= max_points else np.linspace(0, len(cloud) - 1, max_points).astype(int)
        count[row] = len(cloud[kept])
        points[row, : count[row]] = cloud[kept]
        if cloud_classes is not None:
            classes[row, : count[row]] = cloud_classes[kept]
    return points, count, classes


def mix(main: Batch, also: Batch, *, triplets: bool, share_negatives: bool) -> Batch:
    """Return one batch with the places of `main`, followed by those of `also`.

    Arguments:
      main: First batch.
      also: Second batch, from another dataset.
      triplets: Whether the triplet loss counts the tuples of both batches. Otherwise it counts only those of `main`.
      share_negatives: With `triplets`, whether the places of each batch are negatives of the anchors in the other one.
        The datasets must not share a place.
    """
    negatives = main.negatives
    if triplets:
        other = np.full((len(main.negatives), also.negatives.shape[1]), share_negatives)
        back = np.full((len(also.negatives), main.negatives.shape[1]), share_negatives)
        negatives = np.block([[main.negatives, other], [back, also.negatives]])
    labelled = np.concatenate([main.labelled, also.labelled])
    return dataclasses.replace(main, labelled=labelled, negatives=negatives, also=also)


def in_network_order(x: Shaped[Array, "b *_"], batch: Batch, *, every: int) -> Shaped[Array, "b *_"]:
    """Reorder values of the places of a batch into network order. The segmentation head sees every `every`-th image."""
    return x if batch.also is None else x[_order(batch, every)]


def in_batch_order(x: Shaped[Array, "b *_"], batch: Batch, *, every: int) -> Shaped[Array, "b *_"]:
    """Inverse of `in_network_order`."""
    return x if batch.also is None else x[np.argsort(_order(batch, every))]


def _order(batch: Batch, every: int) -> Int[np.ndarray, "b"]:
    places = len(batch.labelled)
    segmented_slots_first = np.argsort(np.arange(places) % every, kind="stable")
    order = np.empty(places, int)
    order[segmented_slots_first] = np.roll(np.arange(places), -batch.places)
    return order


def tuple_pool(
    recordings: Sequence[Recording], config: TrainConfig, *, frames: Sequence[Int[np.ndarray, "_"]] | None = None
) -> TuplePool:
    """Collect the tuples of the recordings, or of their `frames`. Raises ValueError if there are no tuples."""
    return TuplePool([positions_of(recording) for recording in recordings], config.sampling, frames=frames)


def positions_of(recording: Recording) -> Float[np.ndarray, "n 3"]:
    """Return the positions of a recording, in metres. Raises ValueError if it has none."""
    if recording.positions is None:
        raise ValueError(f"sequence {recording.name} has no poses; training and testing need them")
    return recording.positions


class TupleBatches(BatchSource):
    """Batches of the tuples that `pool` draws, which depend only on the seed, the step and the mined descriptors."""

    def __init__(
        self,
        recordings: Sequence[Recording],
        pool: TuplePool,
        read: Callable[[Int[np.ndarray, "t k"]], Any],
        *,
        seed: int,
        tuples: int,
        mining: Mining | None = None,
        random_places: bool = False,
    ):
        """Draw `tuples` tuples a step, or any places with `random_places`, and read the batch of their frames."""
        self._recordings, self._pool, self._read, self._mining = recordings, pool, read, mining
        self._draw = pool.draw_places if random_places else pool.draw
        self._options = {"seed": seed, "tuples": tuples}
        self.refresh_steps = pool.config.refresh_steps if mining else 0

    def batch(self, step: int) -> Any:
        """Return this host's part of the batch of a step."""
        return self._read(self._frames(step))

    def refresh(self, step: int, state: TrainState) -> None:
        """Recompute the descriptors that mining compares, if negatives are mined."""
        if self._mining is not None:
            self._mining.refresh(step, state)

    def places(self, step: int) -> str:
        """Name the recordings and scans in the batch of a step."""
        places, named = np.unique(self._frames(step)), []
        for number, recording in enumerate(self._recordings):
            ids = [recording.ids[self._pool.frame[f]] for f in places[self._pool.recording[places] == number]]
            named += [f"recording {recording.name} frames {' '.join(ids)}"] if ids else []
        return "; ".join(named)

    def _frames(self, step: int) -> Int[np.ndarray, "t k"]:
        mined: dict[str, Any] = {} if self._mining is None else {"cache": self._mining.cache}
        return self._draw(step=step, **self._options, **mined)


class MixedBatches(BatchSource):
    """Batches with tuples of two datasets. `mixed` is `mix` with its options."""

    def __init__(self, main: TupleBatches, also: TupleBatches, mixed: Callable[[Batch, Batch], Batch]):
        self._main, self._also, self._mixed = main, also, mixed
        self.refresh_steps, self.refresh = main.refresh_steps, main.refresh

    def batch(self, step: int) -> Batch:
        """Return the batch of a step."""
        return self._mixed(self._main.batch(step), self._also.batch(step))

    def places(self, step: int) -> str:
        """Name the recordings and scans of both datasets in the batch of a step."""
        return "; ".join(filter(None, (self._main.places(step), self._also.places(step))))


def batches_of(
    recordings: Sequence[Recording],
    pool: TuplePool,
    config: TrainConfig,
    *,
    also: Sequence[Recording] = (),
    mining: Mining | None = None,
) -> BatchSource:
    """Return the batches of a configuration, with `config.also_tuples` tuples of each step from `also`."""
    share, options = config.share_negatives, {"max_points": config.max_points, "image": config.model.image}
    read = functools.partial(read_batch, share_negatives=share, categories=config.model.categories, **options)
    tuples = config.tuples - config.also_tuples
    main_read = functools.partial(read, recordings, pool, part=own_part(tuples))
    main = TupleBatches(recordings, pool, main_read, seed=config.seed, tuples=tuples, mining=mining)
    if not also:
        return main
    other = tuple_pool(also, config)
    second = TupleBatches(
        also,
        other,
        functools.partial(read, also, other),
        seed=config.seed,
        tuples=config.also_tuples,
        random_places=not config.also_triplets,
    )
    return MixedBatches(main, second, functools.partial(mix, triplets=config.also_triplets, share_negatives=share))
