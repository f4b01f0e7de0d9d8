"""Damaged files of every kind end in a result that is right or in one line that names the file; nothing is written.

SGLPR_FUZZ_CASES=10000 makes so many cases in all, and prints the table of what became of them.
"""

import os
import tempfile
from collections import Counter
from pathlib import Path

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from .damage import Damaged
from .found import FOUND
from .outcome import ALLOWED, Outcome, outcome
from .road import Road
from .roads import ROADS

CASES = int(os.environ.get("SGLPR_FUZZ_CASES", "2000"))
COUNTS: dict[str, Counter[str]] = {}
"""By road, how many cases ended how."""


def try_case(road: Road, damaged: Damaged) -> Outcome:
    """Read a damaged file where nothing else is."""
    with tempfile.TemporaryDirectory() as folder:
        for name, content in {**road.beside, road.file: damaged.content}.items():
            (Path(folder) / name).write_bytes(content)
        return outcome(Path(folder) / road.file, damaged, road.read, lambda found: road.same(found, damaged.content))


@pytest.mark.parametrize("road", ROADS.values(), ids=ROADS)
def test_the_whole_file_is_right(road):
    assert try_case(road, Damaged(road.whole, "same")) == Outcome("right", "")


@pytest.mark.parametrize(("name", "damaged"), FOUND)
def test_what_was_found_stays_found(name, damaged):
    found = try_case(ROADS[name], damaged)
    assert found.kind == "refused", found.text


@pytest.mark.parametrize("road", ROADS.values(), ids=ROADS)
def test_a_damaged_file_is_refused_or_read_rightly(road):
    counts = COUNTS.setdefault(road.name, Counter())

    @settings(
        max_examples=max(CASES // len(ROADS) // road.cost, 1),
        derandomize=True,
        database=None,
        deadline=None,
        suppress_health_check=list(HealthCheck),
    )
    @given(st.sampled_from(sorted(road.damages)), st.randoms(use_true_random=False))
    def tried(name, draw):
        found = try_case(road, damaged := road.damages[name](road.whole, draw))
        counts[found.kind] += 1
        assert found.kind in ALLOWED, f"{road.name}, {name}: {found.kind}: {found.text}\n{damaged.content[:2000]!r}"

    tried()
