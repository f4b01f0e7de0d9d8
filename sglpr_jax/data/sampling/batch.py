"""A batch of training tuples: read from files on the host, rotated and rasterised on the device."""

from collections.abc import Sequence
from typing import Any

import flax.struct
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from sglpr_jax.data.degenerate import check_cloud
from sglpr_jax.data.record import Record
from sglpr_jax.data.recording import Recording
from sglpr_jax.data.sampling.tuples import TuplePool
from sglpr_jax.data.views import View, check_ready_made, cloud_view, image_view, picture
from sglpr_jax.grid import Grid, ImageKind
from sglpr_jax.labels import UNLABELLED

Place = tuple[Any, Any]
"""What is read of one place: an image (h, w) or points (n, 3), and their classes (h, w) or (n,), or None."""


@flax.struct.dataclass
class Batch:
    """Tuples as arrays; t tuples of k = 1 + k_p + k_n places, flattened to b = t k where not said otherwise.

    Either `images` (b, h, w) with their `maps` of classes (b, h, w), or `points` (b, n, 3) with `count` (b,) valid
    ones each and their `classes` (b, n); maps and classes are None where no recording has labels. `labelled` (b,) says
    which places have labels, `negatives` (t, b) which places are negatives of each tuple's anchor, `positives` how many
    places after an anchor are its positives.

    With `also`, a second batch, its places come after those here: `labelled` covers both, and `negatives` both or,
    where the triplet loss does not count the second one, the first alone.
    """

    labelled: Any
    negatives: Any
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

    With `share_negatives` every place of the batch that is far enough from an anchor is its negative, not only those
    of its own tuple. Clouds of more than `max_points` points are thinned evenly. `categories` says how labels are
    sorted into classes; with 0 they are not read. `image` "density" makes an image like the ready-made ones of all
    points of a scan. `part` says which tuples to read; their negatives are still sought among all of the batch.
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
    """What the model sees of each place, rotated by its angle (radians; None: as it is), inside jit on the device.

    No map of classes where there are no labels.
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
        raise ValueError(f"expected all recordings of a batch to be {expected}, found {found} in {recording.name}")
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
                f" {expected[1]} pixels, as of {places[0][0].name}, found {image.shape[0]} x {image.shape[1]}"
            )


def _stacked(pictures: list[Place]) -> tuple[np.ndarray, np.ndarray]:
    """Images, and their maps of classes, UNLABELLED all over where there is none."""
    maps = [np.full(image.shape, UNLABELLED, np.int32) if classes is None else classes for image, classes in pictures]
    return np.stack([image for image, _ in pictures]), np.stack(maps)


def _padded(scans: list[Place], max_points: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Clouds of one size, how many points of each count, and their classes, 0 where there are none."""
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
