"""Removes unreadable scans from a recording, for programs that read the recording repeatedly and in any order."""

import dataclasses
from collections.abc import Callable, Sequence

from sglpr_jax.data.degenerate import check_cloud
from sglpr_jax.data.recording import Recording


def readable(
    recording: Recording,
    *,
    on_bad_scan: Callable[[str, Exception], None],
    on_progress: Callable[[int], None] = lambda done: None,
) -> Recording:
    """Read every scan or image with its labels, and return the recording without invalid scans.

    A scan is invalid if it cannot be read or shows no place (`check_cloud`).

    Arguments:
      recording: Recording to read.
      on_bad_scan: Called with the id and the error of each invalid scan.
      on_progress: Called with the number of scans read.

    Raises:
      ValueError: If all scans are invalid.
    """
    good = []
    for row, scan in enumerate(recording.ids):
        try:
            record = recording.record(row)
            if record.points is not None:
                check_cloud(record.points, name=record.name)
            good.append(row)
        except (ValueError, OSError) as error:
            on_bad_scan(scan, error)
        on_progress(row + 1)
    if not good:
        raise ValueError(f"sequence {recording.name}: expected at least one readable scan, found none")
    return recording if len(good) == len(recording) else only(recording, good)


def only(recording: Recording, rows: Sequence[int]) -> Recording:
    """Return the recording with only the given scans or images. They keep their ids and numbers."""
    return dataclasses.replace(
        recording,
        ids=tuple(recording.ids[row] for row in rows),
        paths=tuple(recording.paths[row] for row in rows),
        label_paths=tuple(recording.label_paths[row] for row in rows) if recording.label_paths else (),
        positions=None if recording.positions is None else recording.positions[list(rows)],
        times=None if recording.times is None else recording.times[list(rows)],
        rows=recording.numbers[list(rows)],
        world_from_lidar=None if recording.world_from_lidar is None else recording.world_from_lidar[list(rows)],
    )
