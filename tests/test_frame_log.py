"""A log returns the records that were appended, but for a damaged one or the end of an unfinished one."""

import itertools
import json

import pytest

from sglpr_jax.files import DataWarning, WriteError
from sglpr_jax.frame_log import HEAD, MARK, FrameLog

ABOUT = {"weights": "a", "sizes": (1, 2)}
RECORDS = [b"first", b"second" * 9, b"\0third"]
SETTINGS_SIZE = HEAD.size + len(json.dumps(ABOUT))
SIZES = [SETTINGS_SIZE, HEAD.size + 5, SETTINGS_SIZE, HEAD.size + 54, HEAD.size + 6]
"""Sizes of settings, the first record, the second copy of the settings, and the other records."""
ENDS = list(itertools.accumulate(SIZES))
FRAME_ENDS = [ENDS[1], ENDS[3], ENDS[4]]


@pytest.fixture
def path(tmp_path):
    log = FrameLog(tmp_path / "new" / "frames.log", ABOUT)
    assert log.end == 0
    for number, record in enumerate(RECORDS):
        log.append(number, record)
    assert log.path.stat().st_size == ENDS[-1]
    return log.path  # not closed, as after a kill


def read(path, **options) -> tuple[list[bytes | None], int]:
    with FrameLog(path, ABOUT, **options) as log:
        return [log.record(frame) for frame in range(log.end)], log.damaged_bytes


def test_a_log_cut_at_any_byte_keeps_whole_records_and_continues(path):
    content = path.read_bytes()
    for size in range(len(content) + 1):
        path.write_bytes(content[:size])
        whole = [record for record, end in zip(RECORDS, FRAME_ENDS, strict=True) if end <= size]
        unfinished = size - max(end for end in (0, *ENDS) if end <= size)
        assert read(path) == (whole, unfinished)
        with FrameLog(path, ABOUT) as log:
            log.append(log.end, b"more")
        assert read(path) == ([*whole, b"more"], unfinished)


def test_a_damaged_byte_loses_one_record_only(path):
    content = path.read_bytes()
    for at in range(len(content)):
        path.write_bytes(content[:at] + bytes([content[at] ^ 1]) + content[at + 1 :])
        begins = (ENDS[0], ENDS[2], ENDS[3])
        lost = [begin <= at < end for begin, end in zip(begins, FRAME_ENDS, strict=True)]
        expected = [None if is_lost else record for record, is_lost in zip(RECORDS, lost, strict=True)]
        found, damaged_bytes = read(path)
        assert found == expected[: 2 if lost[-1] else 3] and damaged_bytes > 0


def test_a_later_record_of_a_frame_replaces_the_earlier_one(path):
    with FrameLog(path, ABOUT) as log:
        log.append(1, b"other")
    assert read(path) == ([RECORDS[0], b"other", RECORDS[2]], 0)


def test_another_file_is_refused_and_unchanged(path):
    path.write_bytes(b"something else")
    with pytest.raises(ValueError, match=r"frames\.log: expected a log of frames, found another file"):
        read(path, restarts=True)
    assert path.read_bytes() == b"something else"


def test_a_file_of_zeros_after_a_power_failure_is_begun_anew(path):
    path.write_bytes(bytes(5000))
    assert read(path) == ([], 5000)


def test_a_log_whose_records_are_all_damaged_is_kept_aside(path):
    content = path.read_bytes().replace(b"\x93FR1", b"\x93FR1\1")
    path.write_bytes(content)
    with pytest.warns(DataWarning, match="found damaged ones; restarting"):
        assert read(path, restarts=True) == ([], 0)
    assert path.with_name("frames.log.damaged").read_bytes() == content


def test_an_unwritable_log_is_named(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(WriteError, match="file"):
        FrameLog(tmp_path / "file" / "frames.log", ABOUT)


def test_a_log_of_other_settings_is_refused_or_begun_anew(path):
    other = {**ABOUT, "weights": "b"}
    with pytest.raises(ValueError, match=rf"{path}: .* same settings, found another weights; use"):
        FrameLog(path, other)
    with (
        pytest.warns(DataWarning, match="found another weights; restarting"),
        FrameLog(path, other, restarts=True) as log,
    ):
        assert log.end == 0
    with FrameLog(path, other) as log:
        assert log.end == 0 and sorted(path.parent.iterdir()) == [path]


def test_a_log_with_damaged_settings_is_refused_or_kept_aside(path):
    content = bytearray(path.read_bytes())
    content[HEAD.size + 1] ^= 1  # the second copy is whole
    path.write_bytes(content)
    assert read(path)[0] == RECORDS
    with FrameLog(path, ABOUT) as log:
        log.append(3, b"")
    assert path.read_bytes().count(b'"weights"') == 2  # the copy that was missing follows
    content[content.index(MARK, ENDS[0] + 1) + HEAD.size + 1] ^= 1
    path.write_bytes(content)
    with pytest.raises(ValueError, match=rf"{path}: expected a log with the same settings, found damaged ones; use"):
        read(path)
    with pytest.warns(DataWarning, match="found damaged ones; restarting"):
        assert read(path, restarts=True) == ([], 0)
    assert path.with_name("frames.log.damaged").read_bytes() == content


def test_without_a_path_nothing_is_stored():
    with FrameLog(None, {}) as log:
        log.append(0, b"is not kept")
        assert log.end == 0 and log.record(0) is None
