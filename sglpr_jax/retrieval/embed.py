"""Computes the descriptor file of a recording, with a model or with any function of images or points."""

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Float32, Int32, Num

from sglpr_jax.data.deskew import DESKEWED
from sglpr_jax.data.mounting import Mounting
from sglpr_jax.data.recording import Record, Recording
from sglpr_jax.data.scaled import SCALE, scale_of
from sglpr_jax.data.scan_stream import OnBadScan, check_readable, scan_stream
from sglpr_jax.data.submap import SUBMAPS
from sglpr_jax.data.views import View, classes_of, rotated, view
from sglpr_jax.fields import Size, check_value
from sglpr_jax.methods.handcrafted import HANDCRAFTED
from sglpr_jax.methods.method import DescribeFn, ImageMethod, Method, RecordMethod, ScanMethod, require_content
from sglpr_jax.methods.registry import network
from sglpr_jax.models.config import ModelConfig
from sglpr_jax.models.input_image import FEWEST_CELLS, field_of_view
from sglpr_jax.models.params import Params
from sglpr_jax.retrieval.descriptor_file import SKIPPED, DescriptorFile
from sglpr_jax.retrieval.record_descriptors import record_descriptors

SCANS_AHEAD = 8
"""Number of scans that are read ahead."""


def embed(
    method: Params | Method,
    recording: Recording,
    *,
    rotation_seed: int | None = None,
    batch: int = 8,
    on_bad_scan: OnBadScan | None = None,
    on_progress: Callable[[int], None] = lambda done: None,
) -> DescriptorFile:
    """Describe every scan or image of a recording with a model or another method.

    Arguments:
      method: Weights of a model, or another method.
      recording: Scans or images to describe.
      rotation_seed: With a seed, every scan is first rotated about z by its own random angle.
      batch: Number of scans that a model describes at a time.
      on_bad_scan: Called with the id and the error of a scan that cannot be read or shows no place. The scan is then
        skipped. By default, its error is raised.
      on_progress: Called with the number of finished scans.

    Raises:
      ValueError: If the recording lacks points or labels that the method needs, if ready-made images do not fit the
        model, or if `batch` is below 1.

    Example:
      params = sglpr_jax.load("sglpr")
      file = sglpr_jax.embed(params, sglpr_jax.open_recording(root, "08"))
      file.save(Path("08.npz"))
    """
    method = network(method) if isinstance(method, Params) else method
    _check(method, recording)
    options = {"rotation_seed": rotation_seed, "on_bad_scan": on_bad_scan, "on_progress": on_progress}
    if isinstance(method, ScanMethod):
        return embed_scans(method, recording, **options)
    if isinstance(method, RecordMethod):
        return embed_records(method, recording, batch=batch, **options)
    return embed_images(method, recording, batch=batch, **options)


def embed_images(
    method: ImageMethod,
    recording: Recording,
    *,
    rotation_seed: int | None = None,
    batch: int = 8,
    on_bad_scan: OnBadScan | None = None,
    on_progress: Callable[[int], None] = lambda done: None,
) -> DescriptorFile:
    """Describe the image of every scan of a recording. The arguments are those of `embed`."""
    check_value(batch, Size, "batch")
    batch = _batch_for(len(recording), batch)
    angles = _angles(len(recording), rotation_seed)
    rows, views = [], []
    descriptors = _Descriptors()

    def see(row: int, record: Record) -> View:
        angle = None if angles is None else jnp.float32(angles[row])
        found = view(record, method.grid, image=method.image, categories=method.categories, angle=angle)
        _check_view(np.asarray(found.image), method.field, name=record.name)
        return found

    labels = bool(method.categories)
    options = {"labels": labels, "ahead": SCANS_AHEAD, "on_bad_scan": on_bad_scan, "on_progress": on_progress}
    for row, seen in scan_stream(recording, see, **options):
        if seen is None:
            continue
        rows.append(row)
        views.append(seen)
        if len(views) == batch:
            descriptors.add(_describe_padded(method.describe, views, batch))
            views = []
    if views:
        descriptors.add(_describe_padded(method.describe, views, batch))
    return _file(method, recording, rows, descriptors.all(), rotation_seed=rotation_seed)


class _Descriptors:
    """Descriptors of finished batches. JAX computes the last batch while the next images are read."""

    def __init__(self):
        self._done: list[Float32[np.ndarray, "b d"]] = []
        self._computing: list[Num[Array | np.ndarray, "b d"]] = []

    def add(self, batch: Num[Array | np.ndarray, "b d"]) -> None:
        """Add a batch and wait for the previous one, so that at most two are in memory."""
        self._done += [np.asarray(one, np.float32) for one in self._computing]
        self._computing = [batch]

    def all(self) -> list[Float32[np.ndarray, "b d"]]:
        """Wait for the last batch and return all descriptors. The last rows are those of its padding."""
        return [*self._done, *(np.asarray(one, np.float32) for one in self._computing)]


def embed_scans(
    method: ScanMethod,
    recording: Recording,
    *,
    rotation_seed: int | None = None,
    on_bad_scan: OnBadScan | None = None,
    on_progress: Callable[[int], None] = lambda done: None,
) -> DescriptorFile:
    """Describe the finite points of every scan of a recording. The arguments are those of `embed`.

    Equal rotation seeds give the same angles as in `embed_images`. If the method needs labels, a scan without labels
    counts as unreadable.
    """
    angles = _angles(len(recording), rotation_seed)
    rows, descriptors = [], []

    def see(row: int, record: Record) -> tuple[Float32[np.ndarray, "n 3"], Int32[np.ndarray, " n"] | None]:
        points, classes = _finite_points(record, labels=method.labels)
        return points if angles is None else rotated(points, angles[row]), classes

    options = {"labels": method.labels, "ahead": SCANS_AHEAD, "on_bad_scan": on_bad_scan, "on_progress": on_progress}
    for row, seen in scan_stream(recording, see, **options):
        if seen is not None:
            rows.append(row)
            descriptors.append(method.describe(*seen)[None])
    return _file(method, recording, rows, descriptors, rotation_seed=rotation_seed)


def embed_records(
    method: RecordMethod,
    recording: Recording,
    *,
    rotation_seed: int | None = None,
    batch: int = 8,
    on_bad_scan: OnBadScan | None = None,
    on_progress: Callable[[int], None] = lambda done: None,
) -> DescriptorFile:
    """Describe every scan or image of a recording with a learned method of another publication.

    The arguments are those of `embed`. Raises ValueError, with the method and the scan, if inputs or descriptors differ
    in shape, or if a descriptor is not finite or contains only zeros.
    """
    check_value(batch, Size, "batch")
    angles = _angles(len(recording), rotation_seed)
    options = {"ahead": SCANS_AHEAD, "on_bad_scan": on_bad_scan, "on_progress": on_progress}
    found = list(record_descriptors(method, recording, angles, batch=_batch_for(len(recording), batch), **options))
    rows, descriptors = [row for row, _ in found], [one[None] for _, one in found]
    return _file(method, recording, rows, descriptors, rotation_seed=rotation_seed)


def scan_image(
    points: Float32[np.ndarray, "n 3"], config: ModelConfig, *, mounting: Mounting | None = None
) -> Float[Array, "h w"]:
    """Compute the image of a scan that a model describes (see `ModelConfig.image`).

    Images from other sources can be checked with `is_describable`.

    Arguments:
      points: Points in metres: x forward, y left, z up.
      config: Configuration of the model.
      mounting: Mounting of the sensor, from `estimate_mounting`. None means gravity-aligned, 1.73 m above the ground.

    Raises:
      ValueError: If the scan shows no place: no finite points, coordinates not in metres, or almost no points where the
        model looks.
    """
    image = view(Record(points=points, mounting=mounting), config.grid, image=config.image).image
    _check_view(np.asarray(image), field_of_view(config)[0], name="the scan")
    return jnp.asarray(image)


def _check_view(image: Float[np.ndarray, "h w"], field: Bool[np.ndarray, "h w"] | None, *, name: str) -> None:
    """Raise ValueError if too few cells of an image within `field` (None: everywhere) are occupied."""
    cells = np.count_nonzero(image if field is None else image * field)
    if cells < FEWEST_CELLS:
        raise ValueError(
            f"{name}: expected points in at least {FEWEST_CELLS} cells of the window of {image.shape[0]} x"
            f" {image.shape[1]} cells, found points in {cells}"
        )


def _check(method: Method, recording: Recording) -> None:
    """Raise ValueError if the recording lacks points or labels that the method needs."""
    name, beside = method.about["method"], f"labels beside the scans, found none in sequence {recording.name}"
    if isinstance(method, ImageMethod):
        if method.categories and not recording.has_labels:
            raise ValueError(f"this model also needs labels (model.head.input): expected {beside}")
        return
    if isinstance(method, RecordMethod):
        require_content(name, method.takes, recording)
        return
    if recording.has_images:
        others = ", ".join(other.name for other in HANDCRAFTED.values() if other.takes == "images")
        raise ValueError(f"{name} needs points, found only images in sequence {recording.name}; use {others}")
    if method.labels and not recording.has_labels:
        raise ValueError(f"{name} needs {beside}")


def _angles(n: int, seed: int | None) -> Float[np.ndarray, " n"] | None:
    return None if seed is None else np.random.default_rng(seed).uniform(0, 2 * np.pi, n)


def _file(
    method: Method, recording: Recording, rows: list[int], descriptors: list[np.ndarray], *, rotation_seed: int | None
) -> DescriptorFile:
    """Return the descriptor file of the given rows. Raises ValueError if there are no rows.

    `descriptors` may contain additional rows at the end, the padding of the last batch.
    """
    check_readable(recording, len(rows))
    sensor = {} if recording.mounting is None else {"sensor": str(recording.mounting)}
    skipped = sorted(set(range(len(recording))) - set(rows))  # needed to add poses of all scans later
    made = {name: value for name, value in recording.read_options.items() if name in (DESKEWED, SUBMAPS)}
    scale = {SCALE: scale_of(recording)} if scale_of(recording) != 1 else {}
    config = {"data": recording.name, **sensor, **made, **scale, **method.about, "rotation_seed": rotation_seed}
    return DescriptorFile(
        sequence=recording.name,
        ids=tuple(recording.ids[row] for row in rows),
        positions=None if recording.positions is None else recording.positions[rows],
        times=None if recording.times is None else recording.times[rows],
        descriptors=np.concatenate(descriptors)[: len(rows)],
        pose_source=recording.pose_source,
        config={**config, SKIPPED: skipped} if skipped else config,
        weights_hash=method.weights_hash,
        distance="l2" if isinstance(method, ImageMethod) else method.distance,
    )


def _finite_points(
    record: Record, *, labels: bool
) -> tuple[Float32[np.ndarray, "n 3"], Int32[np.ndarray, " n"] | None]:
    """Return the finite points of one scan and, with `labels`, their classes."""
    assert record.points is not None
    finite = np.isfinite(record.points).all(axis=1)
    return record.upright_points[finite], classes_of(record, 20)[finite] if labels else None


def _batch_for(scans: int, batch: int) -> int:
    """Return `batch` or, for fewer scans, the next power of two: few sizes are compiled, and little padding is
    described."""
    return min(batch, 2 ** max(scans - 1, 0).bit_length())


def _describe_padded(describe: DescribeFn, views: list[View], batch: int) -> Num[Array | np.ndarray, "b d"]:
    """Describe up to `batch` images in a call of constant shape, so that it compiles once. Does not wait for the
    result."""
    padded = views + [views[-1]] * (batch - len(views))
    stacked = jax.tree.map(lambda *each: np.stack(each), *padded)
    inputs = [each for each in stacked if each is not None]
    return describe(*inputs)
