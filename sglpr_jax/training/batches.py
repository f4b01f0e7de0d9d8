"""A batch of training tuples: read from files on the host, rotated and rasterised on the device."""

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
from sglpr_jax.training.tuples import TuplePool


@flax.struct.dataclass
class Batch:
    """Training tuples as arrays: t tuples of k = 1 + k_p + k_n places, flattened to b = t k places.

    k_p and k_n are the numbers of positives and negatives of an anchor. A batch has either `images` with `maps`, or
    `points` with `count` and `classes`. Batches without labels have neither `maps` nor `classes`.
    """

    labelled: Any
    """Whether each place has labels (b,), including the places of `second`."""
    negatives: Any
    """Whether each place is a negative of each anchor (t, b). Covers `second`, unless the triplet loss ignores it."""
    positives: int = flax.struct.field(pytree_node=False)
    """Number of positives of each anchor. They follow the anchor in its tuple."""
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
    teacher: Any = None
    """Descriptors of the teacher (b, d), including those of `second`, or None without `loss.teacher`."""
    second: Any = None
    """None, or the batch of a second dataset, such as simulated scans with labels beside real images without labels."""

    @property
    def places(self) -> int:
        """Number of places, without those of `second`."""
        return len(self.points if self.images is None else self.images)


def read_batch(
    recordings: Sequence[Recording],
    pool: TuplePool,
    places: Int[np.ndarray, "t k"],
    *,
    max_points: int,
    share_negatives: bool,
    categories: int = 20,
    image: ImageKind = "points",
    part: slice = slice(None),
) -> Batch:
    """Read the scans or ready-made images of training tuples.

    Arguments:
      recordings: Recordings of the pool.
      pool: Pool of the places.
      places: Place numbers of the pool, one row (anchor, positives, negatives) per tuple, from `TuplePool.draw`.
      max_points: Maximum number of points of a scan. Larger scans are thinned evenly.
      share_negatives: Whether every place of the batch that is far enough from an anchor is its negative. Otherwise
        only the negatives of its own tuple count.
      categories: Number of classes; with 0 no labels are read.
      image: Kind of image. "density" computes density images from all points of a scan.
      part: Tuples to read. Their negatives come from the whole batch.

    Raises ValueError if the batch mixes scans and images, images differ in size, or a scan has no usable points.
    """
    tuples, tuple_size = places.shape
    negatives = pool.far_apart(places[:, :1], places.reshape(1, -1))
    if not share_negatives:
        is_own_tuple, is_negative = np.eye(tuples, dtype=bool), np.arange(tuple_size) > pool.config.positives
        negatives &= np.kron(is_own_tuple, is_negative)
    has_labels = categories > 0 and any(recording.has_labels for recording in recordings)
    has_images = recordings[0].has_images
    gives_images = has_images or image == "density"
    clouds_or_images, classes = [], []
    read_places = places[part].reshape(-1)
    for place in read_places:
        recording, frame = recordings[int(pool.recording_of[place])], int(pool.frame_of[place])
        if recording.has_images != has_images:
            expected, found = ("images", "scans") if has_images else ("scans", "images")
            raise ValueError(f"expected only {expected} in a batch, found {found} in recording {recording.name}")
        cloud_or_image, place_classes = _read_place(recording, frame, categories if has_labels else 0, image)
        if gives_images and clouds_or_images and cloud_or_image.shape != clouds_or_images[0].shape:
            first_recording = recordings[int(pool.recording_of[read_places[0]])]
            expected, found = ("{} x {}".format(*array.shape) for array in (clouds_or_images[0], cloud_or_image))
            raise ValueError(
                f"recording {recording.name}, frame {recording.ids[frame]}: expected an image of {expected} pixels, "
                f"as in {first_recording.name}, found {found}"
            )
        clouds_or_images.append(cloud_or_image)
        classes.append(place_classes)
    labelled = np.array([place_classes is not None for place_classes in classes])
    batch = Batch(labelled=labelled, negatives=negatives[part], positives=pool.config.positives)
    if not gives_images:
        points, count, point_classes = _pad_clouds(clouds_or_images, classes, max_points)
        return dataclasses.replace(batch, points=points, count=count, classes=point_classes if has_labels else None)
    unlabelled = np.full(clouds_or_images[0].shape, UNLABELLED, np.int32)
    maps = [unlabelled if place_classes is None else place_classes for place_classes in classes]
    return dataclasses.replace(batch, images=np.stack(clouds_or_images), maps=np.stack(maps) if has_labels else None)


def views(batch: Batch, angles: Float[Array, "b"] | None, grid: Grid) -> View:
    """Return the model input of all places, inside jit on the device: images, and maps of classes if there are labels.

    `angles` rotate each place, in radians. The places of `batch.second` follow those of the batch itself.
    """
    if batch.second is None and batch.images is not None:
        return image_view(batch.images, batch.maps, grid, angles)
    if batch.second is None:
        return cloud_view(batch.points, batch.classes, batch.count, grid, angles)
    first_angles = None if angles is None else angles[: batch.places]
    second_angles = None if angles is None else angles[batch.places :]
    first = dataclasses.replace(batch, second=None)
    both = (views(first, first_angles, grid), views(batch.second, second_angles, grid))
    images = jnp.concatenate([view.image for view in both])
    if all(view.classes is None for view in both):
        return View(images)
    maps = [jnp.full(view.image.shape, UNLABELLED) if view.classes is None else view.classes for view in both]
    return View(images, jnp.concatenate(maps))


def _read_place(
    recording: Recording, frame: int, categories: int, image: ImageKind
) -> tuple[np.ndarray, np.ndarray | None]:
    """Read an image (h, w) or points (n, 3), and their classes (h, w) or (n,), or None without labels.

    `check_cloud` raises ValueError if its points are unusable, `check_ready_made` if its image is no density image.
    """
    scan = recording.scan(frame, labels=categories > 0)
    if scan.points is not None:
        check_cloud(scan.points, name=scan.name)
    check_ready_made(scan, image)
    classes = scan.classes(categories) if categories else None
    if scan.points is None or image == "density":
        return picture(scan, classes)
    return scan.upright_points, classes


def _pad_clouds(
    clouds: Sequence[np.ndarray], classes: Sequence[np.ndarray | None], max_points: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Pad or evenly thin clouds to `max_points`. Returns points, numbers of valid points, and classes (0: no label)."""
    points = np.zeros((len(clouds), max_points, 3), np.float32)
    point_classes = np.zeros((len(clouds), max_points), np.int32)
    count = np.zeros(len(clouds), np.int32)
    for place, (cloud, cloud_classes) in enumerate(zip(clouds, classes, strict=True)):
        kept = slice(None) if len(cloud) <= max_points else np.linspace(0, len(cloud) - 1, max_points).astype(int)
        count[place] = len(cloud[kept])
        points[place, : count[place]] = cloud[kept]
        if cloud_classes is not None:
            point_classes[place, : count[place]] = cloud_classes[kept]
    return points, count, point_classes


def mix(first: Batch, second: Batch, *, triplets: bool, share_negatives: bool) -> Batch:
    """Return one batch with the places of `first`, followed by those of `second`, which is from another dataset.

    With `triplets`, the triplet loss counts the tuples of both batches, otherwise only those of `first`. With
    `share_negatives`, too, the places of each batch are negatives of the anchors in the other one.
    """
    negatives = first.negatives
    if triplets:
        first_to_second = np.full((len(first.negatives), second.negatives.shape[1]), share_negatives)
        second_to_first = np.full((len(second.negatives), first.negatives.shape[1]), share_negatives)
        negatives = np.block([[first.negatives, first_to_second], [second_to_first, second.negatives]])
    labelled = np.concatenate([first.labelled, second.labelled])
    return dataclasses.replace(first, labelled=labelled, negatives=negatives, second=second)


def in_network_order(x: Shaped[Array, "b *_"], batch: Batch, *, every: int) -> Shaped[Array, "b *_"]:
    """Reorder values of the places of a batch for the network, whose segmentation head sees every `every`-th image.

    Places of `batch.second`, which have labels, come to these positions, so that the head spends no time on images
    without labels. Without a second batch, the order stays.
    """
    return x if batch.second is None else x[_network_order(batch, every)]


def in_batch_order(x: Shaped[Array, "b *_"], batch: Batch, *, every: int) -> Shaped[Array, "b *_"]:
    """Undo `in_network_order`."""
    return x if batch.second is None else x[np.argsort(_network_order(batch, every))]


def _network_order(batch: Batch, every: int) -> Int[np.ndarray, "b"]:
    """Return the place of the batch at each position of the network. Positions 0, `every`, ... get the second batch."""
    places = len(batch.labelled)
    segmented_positions_first = np.argsort(np.arange(places) % every, kind="stable")
    second_batch_first = np.roll(np.arange(places), -batch.places)
    order = np.empty(places, int)
    order[segmented_positions_first] = second_batch_first
    return order
