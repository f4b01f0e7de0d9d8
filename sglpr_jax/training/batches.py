"""A batch of training tuples: read from files on the host, rotated and rasterised on the device.

A batch may mix two sources, such as real images without labels and simulated scans with labels. The segmentation head
sees every n-th image of the network's order, so labelled places of a second source are put there. The head then spends
no time on images without labels.
"""

import dataclasses
from collections.abc import Sequence
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
from sglpr_jax.training.config import TrainConfig
from sglpr_jax.training.tuples import TuplePool


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
    has_images = recordings[0].has_images
    as_pictures = has_images or image == "density"
    contents, classes = [], []
    rows = frames[part].reshape(-1)
    for row in rows:
        recording, frame = recordings[int(pool.recording[row])], int(pool.frame[row])
        if recording.has_images != has_images:
            expected, found = ("images", "scans") if has_images else ("scans", "images")
            raise ValueError(f"expected only {expected} in a batch, found {found} in recording {recording.name}")
        content, place_classes = _read_place(recording, frame, categories if has_labels else 0, image)
        if as_pictures and contents and content.shape != contents[0].shape:
            raise ValueError(
                f"recording {recording.name}, frame {recording.ids[frame]}: expected an image of "
                f"{contents[0].shape[0]} x {contents[0].shape[1]} pixels, as in "
                f"{recordings[int(pool.recording[rows[0]])].name}, found {content.shape[0]} x {content.shape[1]}"
            )
        contents.append(content)
        classes.append(place_classes)
    labelled = np.array([place is not None for place in classes])
    batch = Batch(labelled=labelled, negatives=negatives[part], positives=pool.config.positives)
    if not as_pictures:
        points, count, point_classes = _padded(contents, classes, max_points)
        return dataclasses.replace(batch, points=points, count=count, classes=point_classes if has_labels else None)
    maps = [np.full(contents[0].shape, UNLABELLED, np.int32) if place is None else place for place in classes]
    return dataclasses.replace(batch, images=np.stack(contents), maps=np.stack(maps) if has_labels else None)


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
    first, second = (None, None) if angles is None else (angles[: batch.places], angles[batch.places :])
    parts = [views(dataclasses.replace(batch, also=None), first, grid), views(batch.also, second, grid)]
    images = jnp.concatenate([image for image, _ in parts])
    if all(maps is None for _, maps in parts):
        return View(images)
    unlabelled = [jnp.full(image.shape, UNLABELLED) if maps is None else maps for image, maps in parts]
    return View(images, jnp.concatenate(unlabelled))


def _read_place(
    recording: Recording, frame: int, categories: int, image: ImageKind
) -> tuple[np.ndarray, np.ndarray | None]:
    """Read an image (h, w) or points (n, 3), and their classes (h, w) or (n,), or None without labels."""
    scan = recording.scan(frame, labels=categories > 0)
    if scan.points is not None:
        check_cloud(scan.points, name=scan.name)
    check_ready_made(scan, image)
    classes = scan.classes(categories) if categories else None
    return picture(scan, classes) if scan.points is None or image == "density" else (scan.upright_points, classes)


def _padded(
    clouds: Sequence[np.ndarray], classes: Sequence[np.ndarray | None], max_points: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Pad clouds to one size. Returns points, numbers of valid points, and classes (0 without labels)."""
    points = np.zeros((len(clouds), max_points, 3), np.float32)
    point_classes = np.zeros((len(clouds), max_points), np.int32)
    count = np.zeros(len(clouds), np.int32)
    for row, (cloud, labels) in enumerate(zip(clouds, classes, strict=True)):
        rows = slice(None) if len(cloud) <= max_points else np.linspace(0, len(cloud) - 1, max_points).astype(int)
        count[row] = len(cloud[rows])
        points[row, : count[row]] = cloud[rows]
        if labels is not None:
            point_classes[row, : count[row]] = labels[rows]
    return points, count, point_classes


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
        main_to_also = np.full((len(main.negatives), also.negatives.shape[1]), share_negatives)
        also_to_main = np.full((len(also.negatives), main.negatives.shape[1]), share_negatives)
        negatives = np.block([[main.negatives, main_to_also], [also_to_main, also.negatives]])
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
        raise ValueError(f"sequence {recording.name} has no poses; training and scoring need them")
    return recording.positions
