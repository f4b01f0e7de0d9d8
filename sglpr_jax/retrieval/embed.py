"""Computes the descriptor file of a recording, with a model or with any function of images or points."""

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Float32, Int32, Num, Shaped

from sglpr_jax.bev import rotate_image
from sglpr_jax.data.deskew import DESKEWED
from sglpr_jax.data.mounting import Mounting
from sglpr_jax.data.recording import Record, Recording
from sglpr_jax.data.scaled import SCALE, scale_of
from sglpr_jax.data.scan_stream import OnBadScan, check_readable, scan_stream
from sglpr_jax.data.submap import SUBMAPS
from sglpr_jax.data.views import View, classes_of, rotated, view
from sglpr_jax.fields import Size, check_value
from sglpr_jax.methods.handcrafted import HANDCRAFTED
from sglpr_jax.methods.learned.describe import check_descriptors
from sglpr_jax.methods.method import ImageMethod, Method, RecordMethod, ScanMethod, require_content
from sglpr_jax.methods.registry import network
from sglpr_jax.models.config import ModelConfig
from sglpr_jax.models.input_image import FEWEST_CELLS, field_of_view
from sglpr_jax.models.params import Params
from sglpr_jax.retrieval.descriptor_file import SKIPPED, DescriptorFile

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
    check_value(batch, Size, "batch")
    batch = 1 if isinstance(method, ScanMethod) else min(batch, 2 ** max(len(recording) - 1, 0).bit_length())
    angles = None
    if rotation_seed is not None:
        angles = np.random.default_rng(rotation_seed).uniform(0, 2 * np.pi, len(recording))
    prepare, describe, labels = _steps(method, angles, batch)
    options = {"labels": labels, "ahead": SCANS_AHEAD, "on_bad_scan": on_bad_scan, "on_progress": on_progress}
    rows, waiting, found = [], [], []

    def describe_waiting() -> None:
        names = [f"scan {recording.ids[row]} of sequence {recording.name}" for row in rows[-len(waiting) :]]
        found.append(describe(waiting + [waiting[-1]] * (batch - len(waiting)), names))
        found[-2:-1] = [np.asarray(one, np.float32) for one in found[-2:-1]]  # JAX computes the last batch meanwhile
        waiting.clear()

    for row, seen in scan_stream(recording, prepare, **options):
        if seen is not None:
            rows.append(row)
            waiting.append(seen)
            if len(waiting) == batch:
                describe_waiting()
    if waiting:
        describe_waiting()
    return _file(method, recording, rows, found, rotation_seed=rotation_seed)


class _Steps(NamedTuple):
    """How a method describes scans."""

    prepare: Callable[[int, Record], Any]
    """Input for the method, from the row and the record of a scan. Called in several threads."""
    describe: Callable[[list[Any], list[str]], Num[Array | np.ndarray, "b d"]]
    """Descriptors of a batch of inputs, which is padded, and the names of its scans, without padding."""
    labels: bool
    """Whether the labels of the scans are read, too."""


def _steps(method: Method, angles: Float[np.ndarray, " n"] | None, batch: int) -> _Steps:
    if isinstance(method, ImageMethod):
        return _Steps(partial(_image_input, method, angles), partial(_describe_images, method), bool(method.categories))
    if isinstance(method, RecordMethod):
        labels = method.takes == "labelled points"
        return _Steps(partial(_record_input, method, angles), partial(_describe_records, method), labels)
    return _Steps(partial(_scan_input, method, angles), lambda seen, _: method.describe(*seen[0])[None], method.labels)


def _image_input(method: ImageMethod, angles: Float[np.ndarray, " n"] | None, row: int, record: Record) -> View:
    angle = None if angles is None else jnp.float32(angles[row])
    found = view(record, method.grid, image=method.image, categories=method.categories, angle=angle)
    _check_view(np.asarray(found.image), method.field, name=record.name)
    return found


def _describe_images(method: ImageMethod, views: list[View], names: list[str]) -> Num[Array | np.ndarray, "b d"]:
    """Describe images in a call of constant shape, so that it compiles once. Does not wait for the result."""
    stacked = jax.tree.map(lambda *each: np.stack(each), *views)
    return method.describe(*(each for each in stacked if each is not None))


def _scan_input(
    method: ScanMethod, angles: Float[np.ndarray, " n"] | None, row: int, record: Record
) -> tuple[Float32[np.ndarray, "n 3"], Int32[np.ndarray, " n"] | None]:
    """The finite points of a scan, and their classes if the method needs them."""
    assert record.points is not None
    finite = np.isfinite(record.points).all(axis=1)
    points, classes = record.upright_points[finite], classes_of(record, 20)[finite] if method.labels else None
    return points if angles is None else rotated(points, angles[row]), classes


def _record_input(
    method: RecordMethod, angles: Float[np.ndarray, " n"] | None, row: int, record: Record
) -> Shaped[np.ndarray, "..."]:
    return method.prepare(record if angles is None else rotated_record(record, float(angles[row])))


def rotated_record(record: Record, angle: float) -> Record:
    """Return a record whose scan or image is rotated by an angle in radians, counter-clockwise."""
    if record.points is not None:
        return replace(record, points=rotated(record.upright_points, angle), mounting=None)
    assert record.image is not None
    return replace(record, image=np.asarray(rotate_image(jnp.asarray(record.image), jnp.float32(angle))))


def _describe_records(method: RecordMethod, inputs: list[np.ndarray], names: list[str]) -> Float32[np.ndarray, "n d"]:
    """Describe inputs in a call of constant shape. Raises ValueError, with the method and the scan, if inputs differ in
    shape, or if a descriptor is not finite or contains only zeros."""
    name = method.about["method"]
    for scan, one in zip(names, inputs, strict=False):
        if one.shape != inputs[0].shape:
            raise ValueError(
                f"{name}: expected an input {inputs[0].shape} of {scan} as of {names[0]}, found {one.shape}"
            )
    described = np.asarray(method.describe(np.stack(inputs)))
    return check_descriptors(name, described[: len(names)], names)


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


def _file(
    method: Method, recording: Recording, rows: list[int], descriptors: list[Any], *, rotation_seed: int | None
) -> DescriptorFile:
    """Return the descriptor file of the given rows. Raises ValueError if there are no rows.

    `descriptors` may contain additional rows at the end, the padding of the last batch.
    """
    check_readable(recording, len(rows))
    sizes = sorted({one.shape[1] for one in descriptors})
    if len(sizes) > 1:
        raise ValueError(f"{method.about['method']}: expected descriptors of one length, found {sizes}")
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
        descriptors=np.concatenate([np.asarray(one, np.float32) for one in descriptors])[: len(rows)],
        pose_source=recording.pose_source,
        config={**config, SKIPPED: skipped} if skipped else config,
        weights_hash=method.weights_hash,
        distance="l2" if isinstance(method, ImageMethod) else method.distance,
    )
