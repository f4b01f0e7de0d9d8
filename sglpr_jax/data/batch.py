"""A batch of training tuples: read from files on the host, rotated and rasterised on the device."""

import functools
from collections.abc import Sequence as Many
from typing import Any

import flax.struct
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from sglpr_jax.bev import (
    Grid,
    ImageKind,
    centre_crop,
    even_cells,
    rasterize,
    rasterize_labels,
    rotate_image,
    rotate_labels,
    rotate_points,
)
from sglpr_jax.data.density_image import density_bev, density_label_bev
from sglpr_jax.data.sequence import Drive, ImageSequence, ScanSequence
from sglpr_jax.data.tuples import TuplePool
from sglpr_jax.labels import UNLABELLED, to_classes


@flax.struct.dataclass
class Batch:
    """Tuples as arrays; t tuples of k = 1 + k_p + k_n places, flattened to b = t k where not said otherwise.

    Either `images` (b, h, w) with their `maps` of classes (b, h, w), or `points` (b, n, 3) with `count` (b,) valid ones
    each and their `classes` (b, n); maps and classes are None where no drive has labels. `labelled` (b,) says which
    places have labels, `far` (t, b) which places can serve an anchor as negatives, `positives` how many places after an
    anchor are its positives.

    With `also`, a second batch, its places come after those here: `labelled` covers both, and `far` both or, where the
    triplet loss does not count the second one, the first alone.
    """

    labelled: Any
    far: Any
    positives: int = flax.struct.field(pytree_node=False)
    images: Any = None
    maps: Any = None
    points: Any = None
    count: Any = None
    classes: Any = None
    also: Any = None

    @property
    def places(self) -> int:
        """How many places are held here, those of `also` not counted."""
        return len(self.points if self.images is None else self.images)


def read_batch(
    drives: Many[Drive],
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

    With `share_negatives` every place of the batch that is far enough from an anchor is its negative, not only those
    of its own tuple. Clouds of more than `max_points` points are thinned evenly. `categories` says how labels are
    sorted into classes; with 0 they are not read. `image` "density" makes an image like the ready-made ones of all
    points of a scan. `part` says which tuples to read; their negatives are still sought among all of the batch.
    """
    flat = frames.reshape(-1)
    far = pool.far_apart(frames[:, :1], flat[None, :])
    if not share_negatives:
        far &= _own_negatives(frames.shape, positives=pool.config.positives)
    far = far[part]
    places = [(drives[int(pool.drive[f])], int(pool.frame[f])) for f in frames[part].reshape(-1)]
    has_labels = categories > 0 and any(drive.has_labels for drive in drives)
    if isinstance(drives[0], ImageSequence) or image == "density":
        read = _read_image if isinstance(drives[0], ImageSequence) else _density_image
        images, maps, labelled = _stacked([read(*place, categories) for place in places])
        return Batch(labelled, far, pool.config.positives, images=images, maps=maps if has_labels else None)
    points, count, classes, labelled = _padded([_read_scan(*place, categories) for place in places], max_points)
    return Batch(
        labelled, far, pool.config.positives, points=points, count=count, classes=classes if has_labels else None
    )


def views(
    batch: Batch, angles: Float[Array, "b"], grid: Grid
) -> tuple[Float[Array, "b h w"], Int[Array, "b h w"] | None]:
    """The images of a batch after turning each place by its angle, and their semantic maps if there are labels.

    Runs on the device, inside jit.
    """
    if batch.also is None:
        return _views(batch, angles, grid)
    parts = [_views(batch, angles[: batch.places], grid), _views(batch.also, angles[batch.places :], grid)]
    images = jnp.concatenate([image for image, _ in parts])
    if all(maps is None for _, maps in parts):
        return images, None
    unlabelled = [jnp.full(image.shape, UNLABELLED) if maps is None else maps for image, maps in parts]
    return images, jnp.concatenate(unlabelled)


def _views(
    batch: Batch, angles: Float[Array, "b"], grid: Grid
) -> tuple[Float[Array, "b h w"], Int[Array, "b h w"] | None]:
    crop = functools.partial(centre_crop, height=grid.height, width=grid.width)
    maps = None
    if batch.images is not None:
        if batch.maps is not None:
            maps = crop(rotate_labels(even_cells(jnp.asarray(batch.maps)), angles))
        return crop(rotate_image(even_cells(jnp.asarray(batch.images)), angles)), maps
    points = rotate_points(batch.points, angles)
    if batch.classes is not None:
        maps = rasterize_labels(points, batch.classes, grid=grid, count=batch.count)
    return rasterize(points, grid=grid, count=batch.count).astype(jnp.float32), maps


def _own_negatives(shape: tuple[int, int], *, positives: int) -> Bool[np.ndarray, "t b"]:
    tuples, places = shape
    is_negative = np.arange(places) > positives
    return np.kron(np.eye(tuples, dtype=bool), is_negative)


def _read_image(drive: Drive, frame: int, categories: int) -> tuple[np.ndarray, np.ndarray | None]:
    if not isinstance(drive, ImageSequence):
        raise ValueError(f"expected all drives of a batch to be images, found scans in {drive.name}")
    return drive.image(frame), _classes(drive, frame, categories)


def _read_scan(drive: Drive, frame: int, categories: int) -> tuple[np.ndarray, np.ndarray | None]:
    if not isinstance(drive, ScanSequence):
        raise ValueError(f"expected all drives of a batch to be scans, found images in {drive.name}")
    return drive.points(frame), _classes(drive, frame, categories)


def _classes(drive: Drive, frame: int, categories: int) -> np.ndarray | None:
    labels = drive.labels(frame) if categories else None
    return None if labels is None else to_classes(labels, categories=categories)


def _stacked(places: list[tuple[np.ndarray, np.ndarray | None]]) -> tuple[np.ndarray, ...]:
    """Images, their maps of classes (UNLABELLED all over where there is none), and which have one."""
    maps = [np.full(image.shape, UNLABELLED, np.int32) if classes is None else classes for image, classes in places]
    labelled = np.array([classes is not None for _, classes in places])
    return np.stack([image for image, _ in places]), np.stack(maps), labelled


def _density_image(drive: Drive, frame: int, categories: int) -> tuple[np.ndarray, np.ndarray | None]:
    points, classes = _read_scan(drive, frame, categories)
    return density_bev(points), None if classes is None else density_label_bev(points, classes)


def _padded(scans: list[tuple[np.ndarray, np.ndarray | None]], max_points: int) -> tuple[np.ndarray, ...]:
    points = np.zeros((len(scans), max_points, 3), np.float32)
    classes = np.zeros((len(scans), max_points), np.int32)
    count = np.zeros(len(scans), np.int32)
    for row, (cloud, cloud_classes) in enumerate(scans):
        kept = slice(None) if len(cloud) <= max_points else np.linspace(0, len(cloud) - 1, max_points).astype(int)
        count[row] = len(cloud[kept])
        points[row, : count[row]] = cloud[kept]
        if cloud_classes is not None:
            classes[row, : count[row]] = cloud_classes[kept]
    return points, count, classes, np.array([scan_classes is not None for _, scan_classes in scans])
