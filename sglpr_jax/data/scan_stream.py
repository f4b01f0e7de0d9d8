"""Reading of the scans of a recording in order. Bad scans are skipped and reported, or raise their error."""

import contextlib
import dataclasses
import functools
import itertools
import os
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any, NoReturn, TypeVar

import numpy as np
from jaxtyping import Float32

from sglpr_jax.data.recording import Recording
from sglpr_jax.data.scan import Scan, check_cloud

OnBadScan = Callable[[str, Exception], None]
"""Receives the id and the error of a bad scan."""
T = TypeVar("T")
Compute = Callable[[int, Scan], T]
"""Computes a result from the row of a scan and the scan."""
SCANS_AHEAD = 8
"""Usual number of scans that are read ahead."""


def scan_stream(
    recording: Recording,
    compute: Compute[T],
    *,
    rows: Iterable[int] | None = None,
    labels: bool = False,
    ahead: int = 0,
    on_bad_scan: OnBadScan | None = None,
    should_stop: Callable[[], bool] = lambda: False,
    on_progress: Callable[[int], None] = lambda done: None,
) -> Iterator[tuple[int, T | None]]:
    """Yield the row of every scan or image, in order, and the result of `compute`, or None for a bad scan.

    A scan is bad if reading it, `check_cloud` or `compute` raises ValueError or OSError.

    Arguments:
      recording: Scans or images to read.
      compute: Function of the row and the scan. With `ahead` it must be pure, because it runs in other threads.
      rows: Rows to read, by default all. Without `ahead`, a row is taken after the previous scan was processed.
      labels: Whether to read the labels, too.
      ahead: Number of scans that are read ahead.
      on_bad_scan: Called with the id and the error of each bad scan. By default, the error is raised.
      should_stop: Asked before a scan is read. If it returns True, no further scan is read.
      on_progress: Called with the number of rows up to a scan, after the caller has processed the scan.
    """
    rows = range(len(recording)) if rows is None else rows
    rows = itertools.takewhile(lambda row: not should_stop(), rows)
    for row, get_result in _pending_results(recording, compute, rows, labels=labels, ahead=ahead):
        result = None
        try:
            result = get_result()
        except (ValueError, OSError) as error:
            if on_bad_scan is None:
                raise
            on_bad_scan(recording.ids[row], error)
        yield row, result
        on_progress(row + 1)


def check_readable(recording: Recording, readable: int) -> None:
    """Raise ValueError if the number of readable scans of a recording is 0."""
    if not readable:
        raise ValueError(f"sequence {recording.name}: expected at least one readable scan, found none")


def require_content(method: str, takes: str, recording: Recording, *, every_label: bool = False) -> None:
    """Raise ValueError if a recording lacks the points or labels that a method needs: `takes`, e.g. "labelled points".

    With `every_label`, every scan must have labels. Otherwise one label file suffices.
    """
    if takes.endswith("points") and recording.has_images:
        raise ValueError(f"{method} needs points, found only images in sequence {recording.name}")
    if not takes.startswith("labelled"):
        return
    if not recording.has_labels:
        raise ValueError(f"{method} needs labels beside the scans, found none in sequence {recording.name}")
    missing = [scan_id for scan_id, labelled in zip(recording.ids, recording.labelled, strict=True) if not labelled]
    if every_label and missing:
        raise ValueError(
            f"{method} needs labels of every scan, found none for {len(missing)} scans of sequence {recording.name}, "
            f"the first is {missing[0]}"
        )


def _pending_results(
    recording: Recording, compute: Compute[T], rows: Iterable[int], *, labels: bool, ahead: int
) -> Iterator[tuple[int, Callable[[], T]]]:
    """Yield each row and a function that returns the result of `compute` for the row, or raises the error.

    This thread reads the files, because not every file can be read in parallel. With `ahead`, other threads compute.
    """

    def check_and_compute(row: int, scan: Scan) -> T:
        if scan.points is not None:
            check_cloud(scan.points, name=scan.name)
        return compute(row, scan)

    def fail(error: Exception) -> NoReturn:
        raise error

    with ThreadPoolExecutor(os.cpu_count()) as threads:
        pending: deque[tuple[int, Callable[[], T]]] = deque()
        for row in rows:
            try:
                job = functools.partial(check_and_compute, row, recording.scan(row, labels=labels))
                pending.append((row, threads.submit(job).result if ahead else job))
            except (ValueError, OSError) as error:
                pending.append((row, functools.partial(fail, error)))
            if len(pending) > ahead:
                yield pending.popleft()
        yield from pending


def sampled_points(recording: Recording, scans: int) -> Iterator[Float32[np.ndarray, "n 3"] | None]:
    """Yield the points of at most `scans` scans, spread over the recording, or None for unreadable scans."""
    for row in np.unique(np.linspace(0, len(recording) - 1, scans).astype(int)).tolist():
        points = None
        with contextlib.suppress(ValueError, OSError):
            points = recording.points(row)
        yield points


def only_readable(
    recording: Recording, *, on_bad_scan: OnBadScan, on_progress: Callable[[int], None] = lambda done: None
) -> Recording:
    """Read every scan or image with its labels, and return the recording without bad scans (`scan_stream`).

    Raises ValueError if all scans are bad.
    """
    options = {"labels": True, "on_bad_scan": on_bad_scan, "on_progress": on_progress}
    rows = [row for row, is_good in scan_stream(recording, lambda row, scan: True, **options) if is_good]
    check_readable(recording, len(rows))
    return recording if len(rows) == len(recording) else only(recording, rows)


def only(recording: Recording, rows: Sequence[int]) -> Recording:
    """Return the recording with only the scans or images at `rows`. Their ids and numbers stay the same."""
    fields: dict[str, Any] = {}
    for name in ("positions", "times", "world_from_lidar"):
        array = getattr(recording, name)
        fields[name] = None if array is None else array[list(rows)]
    for name in ("ids", "paths", "label_paths", "mountings"):
        values = getattr(recording, name)
        fields[name] = tuple(values[row] for row in rows) if values else values
    return dataclasses.replace(recording, **fields, rows=recording.numbers[list(rows)], read_ups=None)
