"""A journal returns what was appended; an end that is cut or damaged is removed, wherever it was cut."""

import pytest

from sglpr_jax.files import WriteError
from sglpr_jax.live.journal import Journal

SETTINGS = {"format": "live 1", "weights": "a"}
RECORDS = [b"first", b"second" * 50, b"\0third"]


@pytest.fixture
def path(tmp_path):
    journal = Journal(tmp_path / "new" / "journal.bin", SETTINGS)
    assert list(journal.records()) == []
    for record in RECORDS:
        journal.append(record)
    return journal.path  # not closed, as after a kill


def read(path, settings=SETTINGS) -> tuple[list[bytes], int]:
    journal = Journal(path, settings)
    found = list(journal.records())
    journal.close()
    return found, journal.cut


def test_records_come_back(path):
    assert read(path) == (RECORDS, 0)


def test_wherever_it_was_cut_whole_records_stay_and_more_can_follow(path):
    content = path.read_bytes()
    for size in range(len(content)):
        path.write_bytes(content[:size])
        whole, cut = read(path)
        assert whole == RECORDS[: len(whole)]
        journal = Journal(path, SETTINGS)
        assert list(journal.records()) == whole and journal.cut == 0
        journal.append(b"more")
        journal.close()
        assert read(path) == ([*whole, b"more"], 0)
        assert len(whole) < 3 and (cut > 0 or len(content[:size]) in ends(content) or not whole)


def ends(content: bytes) -> set[int]:
    """Sizes of the file after each record."""
    sizes, at = set(), 0
    while at < len(content):
        at += 8 + int.from_bytes(content[at : at + 4], "little")
        sizes.add(at)
    return sizes


def test_a_damaged_record_ends_the_journal(path):
    content = bytearray(path.read_bytes())
    content[-40] ^= 1  # in the second record
    path.write_bytes(content)
    found, cut = read(path)
    assert found == RECORDS[:1] and cut > 0


def test_other_settings_and_other_files_are_refused(path):
    with pytest.raises(ValueError, match=r"journal.bin: expected a map with the same settings, found another weights"):
        Journal(path, {**SETTINGS, "weights": "b"})
    with pytest.raises(ValueError, match=r"\(live 2\), found another file"):
        Journal(path, {"format": "live 2"})
    path.write_bytes(b"something else" * 20)
    with pytest.raises(ValueError, match="expected the journal of a live map, found another file"):
        Journal(path, SETTINGS)
    assert path.read_bytes() == b"something else" * 20


def test_a_place_that_cannot_be_written_is_named(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(WriteError, match="file"):
        Journal(tmp_path / "file" / "journal.bin", SETTINGS)
