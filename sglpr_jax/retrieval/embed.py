"""Computes the descriptor file of a recording, with a model or with any function of images or points."""

from collections.abc import Callable, Iterable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Float32

from sglpr_jax.data.deskew import DESKEWED
from sglpr_jax.data.mounting import Mounting
from sglpr_jax.data.recording import Recording
from sglpr_jax.data.scaled import SCALE, scale_of
from sglpr_jax.data.scan import Scan
from sglpr_jax.data.scan_stream import OnBadScan, check_readable, scan_stream
from sglpr_jax.data.submap import SUBMAPS
from sglpr_jax.data.warning import warn
from sglpr_jax.fields import Size, check_value
from sglpr_jax.methods.method import LABELLED, Method, check_descriptors, require_content
from sglpr_jax.methods.registry import checked_view, network
from sglpr_jax.models.config import WHITENING_POWER, ModelConfig
from sglpr_jax.models.input_image import field_of_view
from sglpr_jax.models.params import Params
from sglpr_jax.models.weights import unwhitened, whitened
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
    require_content(method.name, method.takes, recording)
    check_value(batch, Size, "batch")
    batch = min(batch, 2 ** max(len(recording) - 1, 0).bit_length())
    angles = None
    if rotation_seed is not None:
        angles = np.random.default_rng(rotation_seed).uniform(0, 2 * np.pi, len(recording))

    def prepare(row: int, scan: Scan) -> Any:
        return method.prepare(scan, None if angles is None else float(angles[row]))

    labels = method.takes in LABELLED
    options = {"labels": labels, "ahead": SCANS_AHEAD, "on_bad_scan": on_bad_scan, "on_progress": on_progress}
    rows, waiting, found = [], [], []

    def describe_waiting() -> None:
        names = [f"scan {recording.ids[row]} of sequence {recording.name}" for row in rows[-len(waiting) :]]
        inputs = _stacked(method, waiting + [waiting[-1]] * (batch - len(waiting)), names)
        found.append(method.describe(inputs))
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


def _stacked(method: Method, inputs: list[Any], names: list[str]) -> Any:
    """Stack the inputs of a batch along a new axis. Raises ValueError, with the method and the scan, if their shapes
    differ."""
    shapes = [[leaf.shape for leaf in jax.tree.leaves(one)] for one in inputs]
    for scan, shape in zip(names, shapes, strict=False):
        if shape != shapes[0]:
            found, expected = shape[0], shapes[0][0]
            raise ValueError(f"{method.name}: expected an input {expected} of {scan} as of {names[0]}, found {found}")
    return jax.tree.map(lambda *each: np.stack(each), *inputs)


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
    scan = Scan(points=points, mounting=mounting, name="the scan")
    seen = checked_view(scan, None, grid=config.grid, image=config.image, field=field_of_view(config)[0])
    return jnp.asarray(seen.image)


def _file(
    method: Method, recording: Recording, rows: list[int], descriptors: list[Any], *, rotation_seed: int | None
) -> DescriptorFile:
    """Return the descriptor file of the given rows. Raises ValueError if there are no rows.

    `descriptors` may contain additional rows at the end, the padding of the last batch.
    """
    check_readable(recording, len(rows))
    sizes = sorted({one.shape[1] for one in descriptors})
    if len(sizes) > 1:
        raise ValueError(f"{method.name}: expected descriptors of one length, found {sizes}")
    together = np.concatenate([np.asarray(one, np.float32) for one in descriptors])[: len(rows)]
    if method.weights_hash:
        check_descriptors(
            method.name, together, [f"scan {recording.ids[row]} of sequence {recording.name}" for row in rows]
        )
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
        descriptors=together,
        pose_source=recording.pose_source,
        config={**config, SKIPPED: skipped} if skipped else config,
        weights_hash=method.weights_hash,
        distance=method.distance,
    )


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
    params = unwhitened(params)
    found = np.concatenate([embed(params, each, on_progress=on_progress).descriptors for each in recordings])
    n, d = found.shape
    if n <= d:
        warn(
            f"expected more than {d} scans for whitening (the length of a descriptor), better ten times that, found {n}"
        )
    return whitened(params, found, power=power)
