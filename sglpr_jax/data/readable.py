"""A recording without the scans that cannot be read, for whoever reads it again and again in any order."""

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
    """Read every scan or image, with its labels, and return the recording of those that can be read and show a place.

    The others are told to `on_bad_scan(id, error)`, and `on_progress` is told how many are done. Raises ValueError
    where none can be read.
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
    """The recording of some of its scans or images."""
    return dataclasses.replace(
        recording,
        ids=tuple(recording.ids[row] for row in rows),
        paths=tuple(recording.paths[row] for row in rows),
        label_paths=tuple(recording.label_paths[row] for row in rows) if recording.label_paths else (),
        positions=None if recording.positions is None else recording.positions[list(rows)],
        times=None if recording.times is None else recording.times[list(rows)],
        world_from_lidar=None if recording.world_from_lidar is None else recording.world_from_lidar[list(rows)],
    )
