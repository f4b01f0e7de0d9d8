"""Damaged files of every kind end in a result that is right or in one line that names the file; nothing is written.

SGLPR_FUZZ_CASES=10000 makes so many cases in all, and prints the table of what became of them. SGLPR_FUZZ_SEED=7 draws
others than those of the quick run.
"""

import os
import tempfile
from collections import Counter
from pathlib import Path
from random import Random

import pytest

from .found import FOUND
from .outcome import ALLOWED, Outcome, outcome
from .road import Case, FolderRoad, Road
from .roads import FILE_ROADS, ROADS

CASES = int(os.environ.get("SGLPR_FUZZ_CASES", "1000"))
SEED = os.environ.get("SGLPR_FUZZ_SEED", "0")
COUNTS: dict[str, Counter[str]] = {}
"""By road, how many cases ended how."""


def try_case(road: Road | FolderRoad, case: Case) -> Outcome:
    """Read a damaged file where nothing else is but the files that must lie beside it."""
    with tempfile.TemporaryDirectory() as folder:
        for name, content in {**case.beside, case.file: case.damaged.content}.items():
            path = Path(folder) / name
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_bytes(content)
        return outcome(road, case, Path(folder))


EVERY_ROAD = [pytest.param(road, marks=[pytest.mark.slow] * road.slow, id=name) for name, road in ROADS.items()]


@pytest.mark.slow
@pytest.mark.parametrize("road", EVERY_ROAD)
def test_the_whole_file_is_right(road):
    assert try_case(road, road.intact()) == Outcome("right", "")


@pytest.mark.parametrize(("name", "damaged"), FOUND)
def test_what_was_found_stays_found(name, damaged):
    road = FILE_ROADS[name]
    found = try_case(road, Case("found", road.file, damaged, road.beside))
    assert found.kind == "refused", found.text


@pytest.mark.parametrize("road", EVERY_ROAD)
def test_a_damaged_file_is_refused_or_read_rightly(road):
    counts, wrong = COUNTS.setdefault(road.name, Counter()), []
    for number in range(max(CASES // len(ROADS) // road.cost, 1)):
        case = road.case(Random(f"{SEED}, {road.name}, {number}"))
        found = try_case(road, case)
        counts[found.kind] += 1
        if found.kind not in ALLOWED:
            said = f"case {number}, {case.kind} of {case.file}: {found.kind}: {found.text}"
            wrong.append(f"{said}\n{case.damaged.content[:2000]!r}")
    assert not wrong, f"{len(wrong)} with the seed {SEED}; the first ones:\n" + "\n\n".join(wrong[:5])
