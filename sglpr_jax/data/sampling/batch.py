"""Batches of training tuples: read from files on the host, rotated and rasterised on the device."""

from collections.abc import Sequence
from typing import Any

import flax.struct
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from sglpr_jax.data.recording import Record, Recording, check_cloud
from sglpr_jax.data.sampling.tuples import TuplePool
from sglpr_jax.data.views import View, check_ready_made, cloud_view, image_view, picture
from sglpr_jax.grid import Grid, ImageKind
from sglpr_jax.labels import UNLABELLED

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
    flat = frames.reshape(-1)
    negatives = pool.far_apart(frames[:, :1], flat[None, :])
    if not share_negatives:
        negatives &= _own_negatives(frames.shape, positives=pool.config.positives)
    has_labels = categories > 0 and any(recording.has_labels for recording in recordings)
    images = recordings[0].has_images
    places = [(recordings[int(pool.recording[f])], int(pool.frame[f])) for f in frames[part].reshape(-1)]
    pictures = images or image == "density"

    def read(recording: Recording, frame: int) -> Place:
        record = _read(recording, frame, images=images, labels=has_labels)
        check_ready_made(record, image)
        classes = record.classes(categories) if has_labels else None
        return picture(record, classes) if pictures else (record.upright_points, classes)

    found = [read(*place) for place in places]
    labelled = np.array([classes is not None for _, classes in found])
    common = {"labelled": labelled, "negatives": negatives[part], "positives": pool.config.positives}
    if pictures:
        _require_one_size(places, found)
        stacked, maps = _stacked(found)
        return Batch(**common, images=stacked, maps=maps if has_labels else None)
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
    if batch.also is None:
        return _views(batch, angles, grid)
    own, others = (None, None) if angles is None else (angles[: batch.places], angles[batch.places :])
    parts = [_views(batch, own, grid), _views(batch.also, others, grid)]
    images = jnp.concatenate([image for image, _ in parts])
    if all(maps is None for _, maps in parts):
        return View(images)
    unlabelled = [jnp.full(image.shape, UNLABELLED) if maps is None else maps for image, maps in parts]
    return View(images, jnp.concatenate(unlabelled))


def _views(batch: Batch, angles: Float[Array, "b"] | None, grid: Grid) -> View:
    if batch.images is not None:
        return image_view(batch.images, batch.maps, grid, angles)
    return cloud_view(batch.points, batch.classes, batch.count, grid, angles)


def _own_negatives(shape: tuple[int, int], *, positives: int) -> Bool[np.ndarray, "t b"]:
    tuples, places = shape
    is_negative = np.arange(places) > positives
    return np.kron(np.eye(tuples, dtype=bool), is_negative)


def _read(recording: Recording, frame: int, *, images: bool, labels: bool) -> Record:
    if recording.has_images != images:
        expected, found = ("images", "scans") if images else ("scans", "images")
        raise ValueError(f"expected only {expected} in a batch, found {found} in recording {recording.name}")
    record = recording.record(frame, labels=labels)
    if record.points is not None:
        check_cloud(record.points, name=record.name)
    return record


def _require_one_size(places: list[tuple[Recording, int]], pictures: list[Place]) -> None:
    expected = pictures[0][0].shape
    for (recording, frame), (image, _) in zip(places, pictures, strict=True):
        if image.shape != expected:
            raise ValueError(
                f"recording {recording.name}, frame {recording.ids[frame]}: expected an image of {expected[0]} x"
                f" {expected[1]} pixels, as in {places[0][0].name}, found {image.shape[0]} x {image.shape[1]}"
            )


def _stacked(pictures: list[Place]) -> tuple[np.ndarray, np.ndarray]:
    """Stack images and maps of classes. Missing maps are filled with UNLABELLED."""
    maps = [np.full(image.shape, UNLABELLED, np.int32) if classes is None else classes for image, classes in pictures]
    return np.stack([image for image, _ in pictures]), np.stack(maps)


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
