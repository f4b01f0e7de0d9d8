"""Removes unreadable scans from a recording, for programs that read the recording repeatedly and in any order."""

import dataclasses
from collections.abc import Callable, Sequence

from sglpr_jax.data.recording import Recording
from sglpr_jax.data.scan_stream import OnBadScan, check_readable, scan_stream


def readable(
    recording: Recording,
    *,
    on_bad_scan: OnBadScan,
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
    options = {"labels": True, "on_bad_scan": on_bad_scan, "on_progress": on_progress}
    good = [row for row, read in scan_stream(recording, lambda row, record: True, **options) if read]
    check_readable(recording, len(good))
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
        mountings=None if recording.mountings is None else tuple(recording.mountings[row] for row in rows),
        read_ups=None,
        world_from_lidar=None if recording.world_from_lidar is None else recording.world_from_lidar[list(rows)],
    )
