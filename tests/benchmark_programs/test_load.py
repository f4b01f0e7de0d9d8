"""Very many scans, and commands that are killed, run twice at once, or meet troubles with the disk."""

import json
import os
import subprocess
import sys

import pytest

from .programs import ROOT, printed, table

pytestmark = pytest.mark.slow
ALL_PARTS = """
import shutil, sys
from pathlib import Path
from benchmarks.robustness import load
made, make_inputs = Path(sys.argv[1], "made"), load.make_inputs
def make_inputs_once(folder):
    if not made.exists():
        make_inputs(made)
    shutil.copytree(made, folder, dirs_exist_ok=True)
load.make_inputs = make_inputs_once
for part, command in ((load.Kills, "simulate images"), (load.Together, "export"), (load.Disk, "export")):
    part(quick=True, commands=(command,), out=Path(sys.argv[1], part.__name__.lower() + ".json")).run()
"""


def test_many_scans_are_described_and_the_memory_is_told():
    rows = table(printed("robustness.load", "scans", "--quick"))
    assert [row[0] for row in rows] == [str(50 * i) for i in range(1, 11)]
    assert all(float(row[3]) > 10 for row in rows)


@pytest.fixture(scope="module")
def disturbed(tmp_path_factory) -> dict[str, list[dict]]:
    """The rows of each table of disturbed commands, by the name of its part.

    One process makes all tables: it forks the commands and has to be without JAX's threads. It makes their inputs once.
    """
    folder = tmp_path_factory.mktemp("disturbed")
    command = (sys.executable, "-c", ALL_PARTS, str(folder))
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    done = subprocess.run(command, capture_output=True, text=True, timeout=600, env=environment)
    assert done.returncode == 0, done.stderr
    return {name: json.loads((folder / f"{name}.json").read_text())["rows"] for name in ("kills", "together", "disk")}


def test_a_command_that_is_killed_leaves_nothing_half_written_and_goes_on(disturbed):
    (row,) = disturbed["kills"]
    assert row["kills"] == 4 and row["files"] > 20
    assert row["half-written"] == row["next run fails"] == row["other bytes"] == 0


def test_two_at_once_and_troubles_with_the_disk_end_well_or_in_one_line(disturbed):
    (row,) = disturbed["together"]
    assert row["both end well"] + row["one is refused"] == 4 and row["fail"] == row["other bytes"] == 0
    rows = disturbed["disk"]
    assert {row["trouble"]: row["refused in one line"] for row in rows if row["anything else"] == 0} == {
        "full disk": 1,
        "read-only folder": 1,
        "a file vanishes": 0,
        "a file is half there": 0,
    }
    assert not any(row["half-written"] for row in rows)


def test_a_map_opens_however_the_command_was_killed():
    output = printed("robustness.kill_map", "--kills", "2", "--scans", "20")
    last = output.splitlines()[-1]
    assert last.startswith("2 kills, a run takes") and "damaged" not in last
    assert "absent" in last or "opened" in last
