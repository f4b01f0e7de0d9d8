"""Descriptors of the scans of a recording, the image of a scan that a model describes, and whitening."""

from collections.abc import Callable, Iterable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Float32

from sglpr_jax.data.choices import SCALE
from sglpr_jax.data.deskew import DESKEWED
from sglpr_jax.data.mounting import Mounting
from sglpr_jax.data.recording import Recording
from sglpr_jax.data.scaled import scale_of
from sglpr_jax.data.scan import Scan
from sglpr_jax.data.scan_stream import SCANS_AHEAD, OnBadScan, check_readable, require_content, scan_stream
from sglpr_jax.data.submap import SUBMAPS
from sglpr_jax.fields import Size, check_value
from sglpr_jax.files import warn
from sglpr_jax.methods.method import LABELLED, Method, check_descriptors
from sglpr_jax.methods.registry import checked_view, network
from sglpr_jax.models.config import WHITENING_POWER, ModelConfig
from sglpr_jax.models.input_image import field_of_view
from sglpr_jax.models.weights import Params, with_whitening, without_whitening
from sglpr_jax.retrieval.descriptor_file import SKIPPED, DescriptorFile


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
    require_content(method.name, method.takes, recording, every_label=on_bad_scan is None)
    check_value(batch, Size, "batch")
    batch = min(batch, 2 ** max(len(recording) - 1, 0).bit_length())  # the power of two for a short recording
    angles = None
    if rotation_seed is not None:
        angles = np.random.default_rng(rotation_seed).uniform(0, 2 * np.pi, len(recording))

    def prepare(row: int, scan: Scan) -> Any:
        """Return the method's input for a scan, rotated by the angle of its row."""
        return method.prepare(scan, None if angles is None else float(angles[row]))

    options = {"labels": method.takes in LABELLED, "ahead": SCANS_AHEAD}
    rows, waiting, descriptors = [], [], []
    """Rows of all described scans, inputs of the next batch, and descriptors of each batch."""

    def describe_waiting() -> None:
        """Describe the waiting inputs as one batch, filled up with copies of the last input."""
        names = [_scan_name(recording, row) for row in rows[-len(waiting) :]]
        inputs = _stacked(method, waiting + [waiting[-1]] * (batch - len(waiting)), names)
        descriptors.append(method.describe(inputs))
        if len(descriptors) > 1:  # JAX still computes the last batch; fetch the one before
            descriptors[-2] = np.asarray(descriptors[-2], np.float32)
        waiting.clear()

    for row, content in scan_stream(recording, prepare, on_bad_scan=on_bad_scan, on_progress=on_progress, **options):
        if content is not None:
            rows.append(row)
            waiting.append(content)
            if len(waiting) == batch:
                describe_waiting()
    if waiting:
        describe_waiting()
    return _descriptor_file(method, recording, rows, descriptors, rotation_seed=rotation_seed)


def _scan_name(recording: Recording, row: int) -> str:
    return f"scan {recording.ids[row]} of sequence {recording.name}"


def _stacked(method: Method, inputs: list[Any], names: list[str]) -> Any:
    """Stack inputs (pytrees of arrays) along a new first axis. Raises ValueError if their shapes differ."""
    shapes = [[leaf.shape for leaf in jax.tree.leaves(content)] for content in inputs]
    for name, shape in zip(names, shapes, strict=False):
        if shape != shapes[0]:
            expected = f"expected an input {shapes[0][0]} of {name} as of {names[0]}"
            raise ValueError(f"{method.name}: {expected}, found {shape[0]}")
    return jax.tree.map(lambda *leaves: np.stack(leaves), *inputs)


def _descriptor_file(
    method: Method, recording: Recording, rows: list[int], descriptors: list[Any], *, rotation_seed: int | None
) -> DescriptorFile:
    """Return the descriptor file of the scans in `rows` of a recording. `descriptors` are batches (b, d). The last one
    may have additional rows at its end, which are dropped. Raises ValueError if there are no rows, if batches differ in
    width, or if a model's descriptors are invalid."""
    check_readable(recording, len(rows))
    widths = sorted({batch.shape[1] for batch in descriptors})
    if len(widths) > 1:
        raise ValueError(f"{method.name}: expected descriptors of one length, found {widths}")
    scan_descriptors = np.concatenate([np.asarray(batch, np.float32) for batch in descriptors])[: len(rows)]
    if method.weights_hash:
        check_descriptors(method.name, scan_descriptors, [_scan_name(recording, row) for row in rows])
    config: dict[str, Any] = {"data": recording.name}
    if recording.mounting is not None:
        config["sensor"] = str(recording.mounting)
    config |= {name: value for name, value in recording.read_options.items() if name in (DESKEWED, SUBMAPS)}
    if scale_of(recording) != 1:
        config[SCALE] = scale_of(recording)
    config |= {**method.about, "rotation_seed": rotation_seed}
    skipped = sorted(set(range(len(recording))) - set(rows))
    if skipped:  # needed to add poses of all scans later
        config[SKIPPED] = skipped
    return DescriptorFile(
        sequence=recording.name,
        ids=tuple(recording.ids[row] for row in rows),
        positions=None if recording.positions is None else recording.positions[rows],
        times=None if recording.times is None else recording.times[rows],
        descriptors=scan_descriptors,
        pose_source=recording.pose_source,
        config=config,
        weights_hash=method.weights_hash,
        distance=method.distance,
    )


def scan_image(
    points: Float32[np.ndarray, "n 3"], config: ModelConfig, *, mounting: Mounting | None = None
) -> Float[Array, "h w"]:
    """Compute the image of a scan that a model describes (see `ModelConfig.image`).

    The function checks the points, so it cannot run under `jit`. Images from other sources can be checked with
    `is_describable`.

    Arguments:
      points: Points in metres: x forward, y left, z up.
      config: Configuration of the model.
      mounting: Mounting of the sensor, from `estimate_mounting`. None means gravity-aligned, 1.73 m above the ground.

    Raises:
      ValueError: If the scan shows no place: no finite points, coordinates not in metres, or almost no points where the
        model looks.
    """
    scan = Scan(points=points, mounting=mounting, name="the scan")
    view = checked_view(scan, None, grid=config.grid, image=config.image, field=field_of_view(config)[0])
    return jnp.asarray(view.image)


def whiten(
    params: Params,
    recordings: Iterable[Recording],
    *,
    power: float = WHITENING_POWER,
    on_progress: Callable[[int], None] = lambda done: None,
) -> Params:
    """Return the weights with a whitening layer fitted to the descriptors of all scans. It replaces an existing layer.

    If there are not more scans than numbers in a descriptor, a warning is issued.

    Arguments:
      params: Weights of the model.
      recordings: Recordings of the sensor.
      power: Principal components are divided by their spread to this power. With 1, all have equal spread.
      on_progress: Called with the number of finished scans of a recording.
    """
    params = without_whitening(params)
    files = [embed(params, recording, on_progress=on_progress) for recording in recordings]
    descriptors = np.concatenate([file.descriptors for file in files])
    n, d = descriptors.shape
    if n <= d:
        warn(
            f"expected more than {d} scans for whitening (the length of a descriptor), better ten times that, found {n}"
        )
    return with_whitening(params, descriptors, power=power)
