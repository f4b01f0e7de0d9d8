"""A log returns the records that were appended, but for a damaged one or the end of an unfinished one."""

import json

import pytest

from sglpr_jax.files import DataWarning, WriteError
from sglpr_jax.frame_log import HEAD, MARK, FrameLog, RunLog

RECORDS = [(0, b"first"), (1, b"second" * 9), (2, b"\0third")]
ENDS = [HEAD.size + 5, 2 * HEAD.size + 59, 3 * HEAD.size + 65]


@pytest.fixture
def path(tmp_path):
    log = FrameLog(tmp_path / "frames.log")
    assert list(log.records()) == []
    for number, record in RECORDS:
        log.append(number, record)
    return log.path  # not closed, as after a kill


def read(path) -> tuple[list[tuple[int, bytes]], int]:
    log = FrameLog(path)
    found = list(log.records())
    log.close()
    return found, log.removed_bytes


def test_a_log_cut_at_any_byte_keeps_whole_records_and_continues(path):
    content = path.read_bytes()
    for size in range(4, len(content) + 1):
        path.write_bytes(content[:size])
        whole = [record for record, end in zip(RECORDS, ENDS, strict=True) if end <= size]
        assert read(path) == (whole, size - ([0, *ENDS][len(whole)]))
        log = FrameLog(path)
        assert list(log.records()) == whole and log.removed_bytes == 0
        log.append(7, b"more")
        assert read(path) == ([*whole, (7, b"more")], 0)


def test_a_damaged_byte_loses_one_record_only(path):
    content = path.read_bytes()
    for at in range(len(content)):
        path.write_bytes(content[:at] + bytes([content[at] ^ 1]) + content[at + 1 :])
        damaged = sum(end <= at for end in ENDS)
        assert read(path)[0] == [record for record in RECORDS if record[0] != damaged]


def test_a_file_that_is_no_log_is_refused_and_unchanged(path):
    path.write_bytes(b"something else")
    with pytest.raises(ValueError, match=r"frames\.log: expected a log of frames, found another file"):
        read(path)
    assert path.read_bytes() == b"something else"


def test_an_unwritable_log_is_named(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(WriteError, match="file"):
        FrameLog(tmp_path / "file" / "frames.log")


def test_a_run_resumes_after_its_last_whole_step_with_the_same_settings_alone(tmp_path):
    path, settings = tmp_path / "new" / "run.log", {"weights": "a", "sizes": (1, 2)}
    with RunLog(path, settings) as log:
        for step in range(4):
            log.append(step, b"step %d" % step)
    content = bytearray(path.read_bytes())
    content[content.index(b"step 2")] ^= 1
    path.write_bytes(content)
    with RunLog(path, settings) as log:
        assert log.records == [b"step 0", b"step 1"]
        log.append(2, b"again")
    with RunLog(path, settings) as log:
        assert log.records == [b"step 0", b"step 1", b"again"]
        log.append(1, b"other")
    assert RunLog(path, settings).records == [b"step 0", b"other"]
    with pytest.warns(DataWarning, match=rf"{path}: expected .* the same settings, found another weights; restarting"):
        assert RunLog(path, {**settings, "weights": "b"}).records == []
    content = bytearray(path.read_bytes())
    assert json.loads(content[HEAD.size : len(content) // 2]) == {"weights": "b", "sizes": [1, 2]}
    with RunLog(path, {**settings, "weights": "b"}) as log:
        log.append(0, b"kept")
    content = bytearray(path.read_bytes())
    content[HEAD.size + 1] ^= 1  # the second copy of the settings is whole
    path.write_bytes(content)
    assert RunLog(path, {**settings, "weights": "b"}).records == [b"kept"]
    content[content.index(MARK, 1) + HEAD.size + 1] ^= 1
    path.write_bytes(content)
    with pytest.warns(DataWarning, match=rf"{path}: expected a checkpoint with its settings, found damaged ones"):
        assert RunLog(path, settings).records == []
    with RunLog(None, {}) as log:
        log.append(0, b"is not kept")
