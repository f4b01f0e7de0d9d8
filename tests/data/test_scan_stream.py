"""A stream of scans yields every row in order, a bad scan as None, and does no more than its caller asks for."""

import threading
from pathlib import Path

import numpy as np
import pytest
from recordings import of_scans, with_points

from sglpr_jax.data.scan import Scan
from sglpr_jax.data.scan_stream import only_readable, scan_stream

SCANS = 6
CLOUDS = {Path(f"{i}.bin"): np.full((5, 3), i + 1, np.float32) for i in range(SCANS)}
WHOLE = of_scans(CLOUDS)
FAR = np.full((5, 3), 1e5, np.float32)


def first_x(row: int, scan: Scan) -> float:
    assert scan.points is not None
    if row == 4:
        raise ValueError("4: expected another row")
    return float(scan.points[0, 0])


def points_with_bad_ones(path: Path) -> np.ndarray:
    if path.stem == "1":
        raise OSError("1.bin: gone")
    return FAR if path.stem == "2" else CLOUDS[path]


BAD = with_points(WHOLE, points_with_bad_ones)


@pytest.mark.parametrize("ahead", [0, 3])
def test_a_bad_scan_is_reported_and_yielded_as_none(ahead):
    told = []
    stream = scan_stream(BAD, first_x, ahead=ahead, on_bad_scan=lambda scan, error: told.append((scan, str(error))))
    assert list(stream) == [(0, 1.0), (1, None), (2, None), (3, 4.0), (4, None), (5, 6.0)]
    assert [scan for scan, _ in told] == ["1", "2", "4"]
    assert told[0][1] == "1.bin: gone" and "scan 2 of sequence 08: expected metres" in told[1][1]
    stream = scan_stream(BAD, first_x, ahead=ahead)
    assert next(stream) == (0, 1.0)
    with pytest.raises(OSError, match=r"1\.bin: gone"):
        next(stream)


def test_a_row_is_taken_and_read_after_the_scan_before_it_was_processed():
    events = []

    def rows():
        for row in (1, 3):
            events.append(("taken", row))
            yield row

    read = with_points(WHOLE, lambda path: events.append(("read", int(path.stem))) or CLOUDS[path])
    for row, _ in scan_stream(read, first_x, rows=rows(), on_progress=lambda done: events.append(("done", done))):
        events.append(("processed", row))
    steps = ("taken", "read", "processed")
    assert events == [*((step, 1) for step in steps), ("done", 2), *((step, 3) for step in steps), ("done", 4)]


@pytest.mark.parametrize("ahead", [0, 2])
def test_after_a_stop_no_scan_is_read_and_those_that_were_are_yielded(ahead):
    read = []
    stream = scan_stream(
        with_points(WHOLE, lambda path: read.append(path) or CLOUDS[path]),
        first_x,
        ahead=ahead,
        should_stop=lambda: len(read) == 3,
    )
    assert [row for row, _ in stream] == [0, 1, 2] and len(read) == 3


@pytest.mark.parametrize("ahead", [0, 3])
def test_this_thread_reads_and_other_threads_compute(ahead):
    reading, looking, here = set(), set(), threading.get_ident()
    read = with_points(WHOLE, lambda path: reading.add(threading.get_ident()) or CLOUDS[path])
    list(scan_stream(read, lambda row, scan: looking.add(threading.get_ident()), ahead=ahead))
    assert reading == {here}
    assert (here in looking) == (not ahead)


def test_fields_of_a_bad_scan_are_removed_with_the_scan():
    whole = of_scans(CLOUDS, positions=np.arange(18.0).reshape(6, 3), times=np.arange(6.0))
    bad = []
    found = only_readable(with_points(whole, points_with_bad_ones), on_bad_scan=lambda scan, error: bad.append(scan))
    assert found.ids == ("0", "3", "4", "5") and bad == ["1", "2"]
    assert found.times.tolist() == [0, 3, 4, 5] and found.positions[:, 0].tolist() == [0, 9, 12, 15]
    np.testing.assert_array_equal(found.points(1), CLOUDS[Path("3.bin")])
    with pytest.raises(ValueError, match="sequence 08: expected at least one readable scan, found none"):
        only_readable(of_scans({Path("1.bin"): FAR}), on_bad_scan=lambda *_: None)
