"""Recordings of corrupted scans, which any method describes like the originals."""

import dataclasses
from pathlib import Path

import numpy as np

from sglpr_jax.data.corruption.corruptions import Corruption, corrupt
from sglpr_jax.data.record import Record
from sglpr_jax.data.recording import Recording


def corrupted(recording: Recording, corruption: Corruption, *, seed: int) -> Recording:
    """Return the recording with every scan corrupted on reading. Ids, positions and times do not change.

    The corruption of a scan is a function of `seed` and its row. Labels stay with their points. Points that are not
    finite are removed.

    Raises:
      ValueError: If the recording contains only images.
    """
    if recording.has_images:
        raise ValueError(
            f"{corruption.name} needs points, found only images in sequence {recording.name}, which can only be "
            "rotated (rotation)"
        )
    row_of = {path: row for row, path in enumerate(recording.paths)}

    def read(path: Path, labels: Path | None, lasers: bool) -> Record:
        row = row_of[path]
        record = recording.read(path, labels, lasers or corruption.needs_lasers)
        try:
            return corrupt_record(record, corruption, rng=np.random.default_rng((seed, row)))
        except ValueError as error:
            scan = f"scan {recording.ids[row]} of sequence {recording.name}"
            raise ValueError(f"{scan}: {corruption.name}: {error}") from error

    return dataclasses.replace(recording, read=read, on_disk=False)


def corrupt_record(record: Record, corruption: Corruption, *, rng: np.random.Generator) -> Record:
    """Corrupt the finite points of a scan, and keep the labels and lasers of the remaining points, but no times."""
    assert record.points is not None
    rows = np.flatnonzero(np.isfinite(record.points).all(axis=1))
    lasers = None if record.lasers is None else record.lasers[rows]
    points, kept = corrupt(record.points[rows], corruption, rng=rng, lasers=lasers)
    left = rows[kept]
    return dataclasses.replace(
        record,
        points=points,
        labels=None if record.labels is None else record.labels[left],
        lasers=None if record.lasers is None else record.lasers[left],
        time_field=None,
    )
