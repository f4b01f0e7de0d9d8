"""From scans or images to descriptors: any function of images, or of points, over a whole sequence."""

from collections.abc import Callable, Iterator
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Float32, Int32

from sglpr_jax.bev import Grid, ImageKind, centre_crop, even_cells, rotate_image, rotate_labels
from sglpr_jax.data.sequence import Drive, ImageSequence, ScanSequence
from sglpr_jax.labels import to_classes
from sglpr_jax.retrieval.descriptor_file import DescriptorFile
from sglpr_jax.retrieval.scan_views import scan_views, turned

DescribeFn = Callable[..., Float[Any, "b d"]]
"""Images of point counts (b, h, w) and, where asked for, maps of classes (b, h, w) in; one descriptor each out."""
DescribeScanFn = Callable[[Float32[np.ndarray, "n 3"], Int32[np.ndarray, " n"] | None], Float32[np.ndarray, " d"]]
"""The points of one scan and, where asked for, their classes in; its descriptor out."""

OnBadScan = Callable[[str, Exception], None]
T = TypeVar("T")


def embed(
    describe: DescribeFn,
    sequence: Drive,
    grid: Grid | None,
    *,
    config: dict[str, Any],
    weights_hash: str = "",
    categories: int = 0,
    image: ImageKind = "points",
    rotation_seed: int | None = None,
    batch: int = 16,
    on_bad_scan: OnBadScan | None = None,
    on_progress: Callable[[int], None] = lambda done: None,
) -> DescriptorFile:
    """Describe the image of every scan of a sequence.

    `grid` is the window to rasterise, or to cut ready-made images to; None leaves those whole. `image` says what raw
    scans are made into. With `categories` the labels beside the scans are read too, and `describe` gets each scan's map
    of so many classes. With `rotation_seed` every scan is first turned about z by its own random angle. A scan that
    cannot be read raises its error, or, given `on_bad_scan(id, error)`, is left out. `on_progress` is told how many
    scans are done.
    """
    angles = _angles(len(sequence), rotation_seed)
    rows, views, descriptors = [], [], []

    def read(row: int) -> tuple[Array, ...]:
        angle = None if angles is None else jnp.float32(angles[row])
        return read_views(sequence, row, grid, categories=categories, image=image, angle=angle)

    for row, view in _readable(sequence, read, on_bad_scan):
        rows.append(row)
        views.append(view)
        if len(views) == batch:
            descriptors.append(_describe_padded(describe, views, batch))
            views = []
            on_progress(row + 1)
    if views:
        descriptors.append(_describe_padded(describe, views, batch))
    on_progress(len(sequence))
    config = {**config, "rotation_seed": rotation_seed}
    return _file(sequence, rows, descriptors, config=config, weights_hash=weights_hash)


def embed_scans(
    describe: DescribeScanFn,
    sequence: ScanSequence,
    *,
    config: dict[str, Any],
    distance: str,
    labels: bool = False,
    rotation_seed: int | None = None,
    on_bad_scan: OnBadScan | None = None,
    on_progress: Callable[[int], None] = lambda done: None,
) -> DescriptorFile:
    """Describe the finite points of every scan of a sequence, with `labels` and their classes.

    `distance` names the function that compares the descriptors; the other options are those of `embed`, and equal seeds
    turn by equal angles. Where labels are asked for, a scan without them is one that cannot be read.
    """
    angles = _angles(len(sequence), rotation_seed)
    rows, descriptors = [], []
    for row, (points, classes) in _readable(sequence, lambda row: _read_scan(sequence, row, labels), on_bad_scan):
        rows.append(row)
        descriptors.append(describe(points if angles is None else turned(points, angles[row]), classes)[None])
        on_progress(row + 1)
    return _file(sequence, rows, descriptors, config={**config, "rotation_seed": rotation_seed}, distance=distance)


def _angles(n: int, seed: int | None) -> Float[np.ndarray, " n"] | None:
    return None if seed is None else np.random.default_rng(seed).uniform(0, 2 * np.pi, n)


def _readable(sequence: Drive, read: Callable[[int], T], on_bad_scan: OnBadScan | None) -> Iterator[tuple[int, T]]:
    """Every readable scan's row and what `read` makes of it."""
    for row in range(len(sequence)):
        try:
            yield row, read(row)
        except (ValueError, OSError) as error:
            if on_bad_scan is None:
                raise
            on_bad_scan(sequence.ids[row], error)


def _file(sequence: Drive, rows: list[int], descriptors: list[np.ndarray], **about: Any) -> DescriptorFile:
    """The descriptors of these rows of a sequence; ValueError where there are none."""
    if not rows:
        raise ValueError(f"sequence {sequence.name}: expected at least one readable scan, found none")
    return DescriptorFile(
        sequence=sequence.name,
        ids=tuple(sequence.ids[row] for row in rows),
        positions=None if sequence.positions is None else sequence.positions[rows],
        times=None if sequence.times is None else sequence.times[rows],
        descriptors=np.concatenate(descriptors),
        pose_source=sequence.pose_source,
        **{"weights_hash": "", **about},
    )


def read_image(
    sequence: Drive,
    row: int,
    grid: Grid | None,
    *,
    image: ImageKind = "points",
    angle: Float[Array, ""] | None = None,
) -> Float[Array, "h w"]:
    """The image of one scan, turned by `angle` radians if given. Raises ValueError where scans come without a grid."""
    return read_views(sequence, row, grid, image=image, angle=angle)[0]


def read_views(
    sequence: Drive,
    row: int,
    grid: Grid | None,
    *,
    categories: int = 0,
    image: ImageKind = "points",
    angle: Float[Array, ""] | None = None,
) -> tuple[Array, ...]:
    """The image of one scan and, with `categories`, its map of so many classes, both turned by `angle` radians.

    Raises ValueError where scans come without a grid, or a scan or image without the labels asked for.
    """
    if isinstance(sequence, ImageSequence):
        cells = even_cells if grid is not None else jnp.asarray
        whole = cells(jnp.asarray(sequence.image(row)))
        views = (whole if angle is None else rotate_image(whole, angle),)
        if categories:
            classes = cells(jnp.asarray(_classes(sequence, row, categories)))
            views += (classes if angle is None else rotate_labels(classes, angle),)
        return views if grid is None else tuple(centre_crop(v, height=grid.height, width=grid.width) for v in views)
    if grid is None:
        raise ValueError("scans need a grid to be rasterised on, found none")
    classes = _classes(sequence, row, categories) if categories else None
    return scan_views(sequence.points(row), grid, image=image, classes=classes, angle=angle)


def _read_scan(
    sequence: ScanSequence, row: int, labels: bool
) -> tuple[Float32[np.ndarray, "n 3"], Int32[np.ndarray, " n"] | None]:
    """The finite points of one scan and, with `labels`, their classes; ValueError where it has none."""
    points = sequence.points(row)
    finite = np.isfinite(points).all(axis=1)
    if not labels:
        return points[finite], None
    return points[finite], _classes(sequence, row, 20)[finite]


def _classes(sequence: Drive, row: int, categories: int) -> Int32[np.ndarray, "..."]:
    """The class of every point of one scan, or pixel of one image; ValueError where it has no labels."""
    raw = sequence.labels(row)
    if raw is None:
        raise ValueError(f"scan {sequence.ids[row]} of sequence {sequence.name}: expected labels, found none")
    return to_classes(raw, categories=categories)


def _describe_padded(describe: DescribeFn, views: list[tuple[Array, ...]], batch: int) -> Float[np.ndarray, "b d"]:
    """Describe up to `batch` images in a call of always the same shape, so that it compiles once."""
    padded = views + [views[-1]] * (batch - len(views))
    stacked = map(jnp.stack, zip(*padded, strict=True))
    return np.asarray(jax.block_until_ready(describe(*stacked)), np.float32)[: len(views)]
