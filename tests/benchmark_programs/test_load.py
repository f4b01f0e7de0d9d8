"""Very many scans, and commands that are killed, run twice at once, or meet troubles with the disk."""

import json

import pytest

from .programs import printed, table

pytestmark = pytest.mark.slow


def test_many_scans_are_described_and_the_memory_is_told():
    rows = table(printed("robustness.load", "scans", "--quick"))
    assert [row[0] for row in rows] == [str(50 * i) for i in range(1, 11)]
    assert all(float(row[3]) > 10 for row in rows)


def test_a_command_that_is_killed_leaves_nothing_half_written_and_goes_on(tmp_path):
    printed(
        "robustness.load", "kills", "--quick", "--commands", "simulate images", "--out", str(tmp_path / "kills.json")
    )
    (row,) = json.loads((tmp_path / "kills.json").read_text())["rows"]
    assert row["kills"] == 4 and row["files"] > 20
    assert row["half-written"] == row["next run fails"] == row["other bytes"] == 0


def test_two_at_once_and_troubles_with_the_disk_end_well_or_in_one_line(tmp_path):
    for part in ("together", "disk"):
        printed("robustness.load", part, "--quick", "--commands", "export", "--out", str(tmp_path / f"{part}.json"))
    (row,) = json.loads((tmp_path / "together.json").read_text())["rows"]
    assert row["both end well"] + row["one is refused"] == 4 and row["fail"] == row["other bytes"] == 0
    rows = json.loads((tmp_path / "disk.json").read_text())["rows"]
    assert {row["trouble"]: row["refused in one line"] for row in rows if row["anything else"] == 0} == {
        "full disk": 1,
        "read-only folder": 1,
        "a file vanishes": 0,
        "a file is half there": 0,
    }
    assert not any(row["half-written"] for row in rows)


def test_a_map_opens_however_the_command_was_killed():
    output = printed("robustness.kill_map", "--kills", "3", "--scans", "30")
    last = output.splitlines()[-1]
    assert last.startswith("3 kills, a run takes") and "damaged" not in last
    assert "absent" in last or "opened" in last
