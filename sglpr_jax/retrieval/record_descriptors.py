"""Descriptors of the scans or images of a recording by a learned method of another publication, in batches."""

import dataclasses
from collections.abc import Iterator
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Float32, Shaped

from sglpr_jax.bev import rotate_image
from sglpr_jax.data.recording import Record, Recording
from sglpr_jax.data.scan_stream import scan_stream
from sglpr_jax.data.views import rotated
from sglpr_jax.methods.learned.describe import check_descriptors
from sglpr_jax.methods.method import RecordMethod


def record_descriptors(
    method: RecordMethod, recording: Recording, angles: Float[np.ndarray, " n"] | None, *, batch: int, **options: Any
) -> Iterator[tuple[int, Float32[np.ndarray, " d"]]]:
    """Yield the row and the descriptor of every readable scan or image.

    Arguments:
      method: Learned method with its weights.
      recording: Scans or images to describe.
      angles: Angle by which each scan is rotated first, in radians, or None.
      batch: Number of scans in a call of the network.
      options: Options of `scan_stream`.

    Raises ValueError, with the method and the scan, if inputs or descriptors differ in shape, or if a descriptor is not
    finite or contains only zeros.
    """

    def see(row: int, record: Record) -> Shaped[np.ndarray, "..."]:
        return method.prepare(record if angles is None else rotated_record(record, float(angles[row])))

    waiting: list[tuple[int, np.ndarray]] = []
    size: int | None = None
    for row, seen in scan_stream(recording, see, labels=method.takes == "labelled points", **options):
        if seen is not None:
            waiting.append((row, seen))
        last = row == len(recording) - 1
        if waiting and (last or len(waiting) == batch):
            found = _described(method, recording, waiting, batch, size)
            size = found.shape[1]
            yield from zip([row for row, _ in waiting], found, strict=True)
            waiting = []


def rotated_record(record: Record, angle: float) -> Record:
    """Return a record whose scan or image is rotated by an angle in radians, counter-clockwise."""
    if record.points is not None:
        return dataclasses.replace(record, points=rotated(record.upright_points, angle), mounting=None)
    assert record.image is not None
    image = np.asarray(rotate_image(jnp.asarray(record.image), jnp.float32(angle)))
    return dataclasses.replace(record, image=image)


def _described(
    method: RecordMethod, recording: Recording, waiting: list[tuple[int, np.ndarray]], batch: int, size: int | None
) -> Float32[np.ndarray, "n d"]:
    """Describe up to `batch` inputs in a call of constant shape. `size` is the length of earlier descriptors."""
    name, first = method.about["method"], waiting[0][1]
    scans = [f"scan {recording.ids[row]} of sequence {recording.name}" for row, _ in waiting]
    for scan, (_, one) in zip(scans, waiting, strict=True):
        if one.shape != first.shape:
            raise ValueError(f"{name}: expected an input {first.shape} of {scan} as of {scans[0]}, found {one.shape}")
    inputs = [one for _, one in waiting]
    described = np.asarray(method.describe(np.stack(inputs + [inputs[-1]] * (batch - len(inputs)))))
    found = check_descriptors(name, described[: len(inputs)], scans)
    if size is not None and found.shape[1] != size:
        raise ValueError(f"{name}: expected {size} numbers of {scans[0]} as of earlier scans, found {found.shape[1]}")
    return found
