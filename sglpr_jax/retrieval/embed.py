"""From a recording to its descriptor file: by a model, or by any function of images or of points."""

import functools
import os
from collections import deque
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Float32, Int32, Num

from sglpr_jax.data.degenerate import check_cloud
from sglpr_jax.data.mounting import Mounting
from sglpr_jax.data.record import Record
from sglpr_jax.data.recording import Recording
from sglpr_jax.data.views import View, classes_of, rotated, view
from sglpr_jax.fields import Size, check_value
from sglpr_jax.grid import Grid, ImageKind
from sglpr_jax.methods.handcrafted import HANDCRAFTED
from sglpr_jax.methods.method import DescribeFn, DescribeScanFn, ImageMethod, Method, ScanMethod
from sglpr_jax.methods.registry import network
from sglpr_jax.models.config import ModelConfig
from sglpr_jax.models.input_image import FEWEST_CELLS, field_of_view
from sglpr_jax.models.params import Params
from sglpr_jax.retrieval.descriptor_file import SKIPPED, DescriptorFile

OnBadScan = Callable[[str, Exception], None]
T = TypeVar("T")
SCANS_AHEAD = 8
"""So many scans are read before the first of them is needed."""


def embed(
    method: Params | Method,
    recording: Recording,
    *,
    rotation_seed: int | None = None,
    batch: int = 8,
    on_bad_scan: OnBadScan | None = None,
    on_progress: Callable[[int], None] = lambda done: None,
) -> DescriptorFile:
    """Describe every scan or image of a recording by a model's weights, or by another method.

    With `rotation_seed` every scan is first rotated about z by its own random angle. A model describes `batch` scans
    at a time. A scan that cannot be read, or shows no place, raises its error, or, given `on_bad_scan(id, error)`, is
    left out. `on_progress` is told how many scans are done. Raises ValueError where the recording has not the points or
    the labels that the method needs, for ready-made images that cannot be what the model wants, and for no batch.

    Example:
      params = sglpr_jax.load("sglpr")
      file = sglpr_jax.embed(params, sglpr_jax.open_recording(root, "08"))
      file.save(Path("08.npz"))
    """
    method = network(method) if isinstance(method, Params) else method
    _check(method, recording)
    sensor = {} if recording.mounting is None else {"sensor": str(recording.mounting)}
    config = {"data": recording.name, **sensor, **method.about}
    options = {"rotation_seed": rotation_seed, "on_bad_scan": on_bad_scan, "on_progress": on_progress}
    if isinstance(method, ScanMethod):
        about = {"config": config, "distance": method.distance, "labels": method.labels}
        return embed_scans(method.describe, recording, **about, **options)
    about = {"config": config, "weights_hash": method.weights_hash, "categories": method.categories}
    about |= {"image": method.image, "field": method.field}
    return embed_images(method.describe, recording, method.grid, **about, batch=batch, **options)


def embed_images(
    describe: DescribeFn,
    recording: Recording,
    grid: Grid | None,
    *,
    config: dict[str, Any],
    weights_hash: str = "",
    categories: int = 0,
    image: ImageKind = "points",
    field: Bool[np.ndarray, "h w"] | None = None,
    rotation_seed: int | None = None,
    batch: int = 8,
    on_bad_scan: OnBadScan | None = None,
    on_progress: Callable[[int], None] = lambda done: None,
) -> DescriptorFile:
    """Describe the image of every scan of a recording.

    `grid` is the window to rasterise, or to cut ready-made images to; None leaves those whole. `image` says what raw
    scans are made into, `field` in which cells the method looks (None: in all). With `categories` the labels beside the
    scans are read too, and `describe` gets each scan's map of so many classes. The other options are those of `embed`.
    """
    check_value(batch, Size, "batch")
    batch = _batch_for(len(recording), batch)
    angles = _angles(len(recording), rotation_seed)
    rows, views = [], []
    descriptors = _Descriptors()

    def read(row: int) -> tuple[int, Record]:
        return row, recording.record(row, labels=bool(categories))

    def see(row: int, record: Record) -> View:
        angle = None if angles is None else jnp.float32(angles[row])
        found = view(record, grid, image=image, categories=categories, angle=angle)
        _check_view(np.asarray(found.image), field, name=record.name)
        return found

    for row, seen in _readable(recording, read, see, on_bad_scan):
        rows.append(row)
        views.append(seen)
        if len(views) == batch:
            descriptors.add(_describe_padded(describe, views, batch))
            views = []
            on_progress(row + 1)
    if views:
        descriptors.add(_describe_padded(describe, views, batch))
    on_progress(len(recording))
    config = {**config, "rotation_seed": rotation_seed}
    return _file(recording, rows, descriptors.all(), config=config, weights_hash=weights_hash)


class _Descriptors:
    """What was described, batch by batch. JAX computes the last one while the next images are being read."""

    def __init__(self):
        self._done: list[Float32[np.ndarray, "b d"]] = []
        self._computing: list[Num[Array | np.ndarray, "b d"]] = []

    def add(self, batch: Num[Array | np.ndarray, "b d"]) -> None:
        """Wait for the batch before, so that no more than two are in memory."""
        self._done += [np.asarray(one, np.float32) for one in self._computing]
        self._computing = [batch]

    def all(self) -> list[Float32[np.ndarray, "b d"]]:
        """The descriptors, after the last batch has ended, and behind them those of its padding."""
        return [*self._done, *(np.asarray(one, np.float32) for one in self._computing)]


def embed_scans(
    describe: DescribeScanFn,
    recording: Recording,
    *,
    config: dict[str, Any],
    distance: str,
    labels: bool = False,
    rotation_seed: int | None = None,
    on_bad_scan: OnBadScan | None = None,
    on_progress: Callable[[int], None] = lambda done: None,
) -> DescriptorFile:
    """Describe the finite points of every scan of a recording, with `labels` and their classes.

    `distance` names the function that compares the descriptors; the other options are those of `embed`, and equal seeds
    rotate by equal angles. Where labels are asked for, a scan without them is one that cannot be read.
    """
    angles = _angles(len(recording), rotation_seed)
    rows, descriptors = [], []

    def read(row: int) -> tuple[Record]:
        return (recording.record(row, labels=labels),)

    finite = functools.partial(_finite_points, labels=labels)
    for row, (points, classes) in _readable(recording, read, finite, on_bad_scan):
        rows.append(row)
        descriptors.append(describe(points if angles is None else rotated(points, angles[row]), classes)[None])
        on_progress(row + 1)
    return _file(recording, rows, descriptors, config={**config, "rotation_seed": rotation_seed}, distance=distance)


def scan_image(
    points: Float32[np.ndarray, "n 3"], config: ModelConfig, *, mounting: Mounting | None = None
) -> Float[Array, "h w"]:
    """The image of a scan (metres; x forward, y left, z up) that a model describes: see `ModelConfig.image`.

    `mounting` says how the sensor was mounted (None: upright, 1.73 m above the ground); `estimate_mounting` finds it.
    Raises ValueError for a scan that shows no place: no finite points, no metres, next to nothing where the model
    looks. For images from elsewhere there is `is_describable`.
    """
    image = view(Record(points=points, mounting=mounting), config.grid, image=config.image).image
    _check_view(np.asarray(image), field_of_view(config)[0], name="the scan")
    return jnp.asarray(image)


def _check_view(image: Float[np.ndarray, "h w"], field: Bool[np.ndarray, "h w"] | None, *, name: str) -> None:
    """Raise ValueError where a method sees too little of an image; `field` says where it looks, None: everywhere."""
    cells = np.count_nonzero(image if field is None else image * field)
    if cells < FEWEST_CELLS:
        raise ValueError(
            f"{name}: expected points in at least {FEWEST_CELLS} cells of the window of {image.shape[0]} x"
            f" {image.shape[1]}, found them in {cells}"
        )


def _check(method: Method, recording: Recording) -> None:
    """Raise ValueError where the recording has not the points or the labels that the method needs."""
    name, beside = method.about["method"], f"labels beside the scans, found none in sequence {recording.name}"
    if isinstance(method, ImageMethod):
        if method.categories and not recording.has_labels:
            raise ValueError(f"this model describes a place from its labels too (model.head.input): expected {beside}")
        return
    if recording.has_images:
        others = ", ".join(other.name for other in HANDCRAFTED.values() if other.takes == "images")
        raise ValueError(f"{name} needs points, found only images in sequence {recording.name}; use {others}")
    if method.labels and not recording.has_labels:
        raise ValueError(f"{name} needs {beside}")


def _angles(n: int, seed: int | None) -> Float[np.ndarray, " n"] | None:
    return None if seed is None else np.random.default_rng(seed).uniform(0, 2 * np.pi, n)


def _readable(
    recording: Recording,
    read: Callable[[int], tuple],
    then: Callable[..., T],
    on_bad_scan: OnBadScan | None,
) -> Iterator[tuple[int, T]]:
    """Every readable scan's row and what `then` makes of what `read` gives, in order.

    `read` is called here, for not every file can be read by two at once; `then`, a pure function, in other threads, a
    few scans ahead.
    """
    with ThreadPoolExecutor(os.cpu_count()) as threads:
        ahead: deque[tuple[int, Future[T]]] = deque()
        for row in range(len(recording) + SCANS_AHEAD):
            if row < len(recording):
                ahead.append((row, _begun(threads, read, then, row)))
            if row >= SCANS_AHEAD and ahead:
                done, seen = ahead.popleft()
                try:
                    yield done, seen.result()
                except (ValueError, OSError) as error:
                    if on_bad_scan is None:
                        raise
                    on_bad_scan(recording.ids[done], error)


def _begun(threads: ThreadPoolExecutor, read: Callable[[int], tuple], then: Callable[..., T], row: int) -> Future[T]:
    """What will come of a row; where it cannot be read, the error that says so."""
    try:
        return threads.submit(then, *read(row))
    except (ValueError, OSError) as error:
        failed: Future[T] = Future()
        failed.set_exception(error)
        return failed


def _file(recording: Recording, rows: list[int], descriptors: list[np.ndarray], **about: Any) -> DescriptorFile:
    """The descriptors of these rows of a recording, the first ones given; ValueError where there are none."""
    if not rows:
        raise ValueError(f"sequence {recording.name}: expected at least one readable scan, found none")
    if len(rows) < len(recording):  # so that poses of all its scans can be given later
        about["config"] = {**about["config"], SKIPPED: sorted(set(range(len(recording))) - set(rows))}
    return DescriptorFile(
        sequence=recording.name,
        ids=tuple(recording.ids[row] for row in rows),
        positions=None if recording.positions is None else recording.positions[rows],
        times=None if recording.times is None else recording.times[rows],
        descriptors=np.concatenate(descriptors)[: len(rows)],
        pose_source=recording.pose_source,
        **{"weights_hash": "", **about},
    )


def _finite_points(
    record: Record, *, labels: bool
) -> tuple[Float32[np.ndarray, "n 3"], Int32[np.ndarray, " n"] | None]:
    """The finite points of one scan and, with `labels`, their classes; ValueError where it shows no place."""
    assert record.points is not None
    check_cloud(record.points, name=record.name)
    finite = np.isfinite(record.points).all(axis=1)
    return record.upright_points[finite], classes_of(record, 20)[finite] if labels else None


def _batch_for(scans: int, batch: int) -> int:
    """`batch`, or for fewer scans the next power of two: few sizes to compile, and little is described in vain."""
    return min(batch, 2 ** max(scans - 1, 0).bit_length())


def _describe_padded(describe: DescribeFn, views: list[View], batch: int) -> Num[Array | np.ndarray, "b d"]:
    """Describe up to `batch` images in a call of always the same shape, so that it compiles once; does not wait."""
    padded = views + [views[-1]] * (batch - len(views))
    stacked = jax.tree.map(lambda *each: np.stack(each), *padded)
    inputs = [each for each in stacked if each is not None]
    return describe(*inputs)
