"""The table of what became of all damaged files, at the end of a run that was asked for it."""

import os

from .outcome import KINDS
from .test_roads import COUNTS


def pytest_terminal_summary(terminalreporter):
    if "SGLPR_FUZZ_CASES" not in os.environ:
        return
    rows = [(name, sum(counts.values()), *(counts[kind] for kind in KINDS)) for name, counts in COUNTS.items()]
    rows.append(("all", *map(sum, zip(*(row[1:] for row in rows), strict=True))))
    terminalreporter.section("damaged files")
    for row in (("road", "cases", *KINDS), *rows):
        terminalreporter.write_line(f"{row[0]:20}" + "".join(f"{value:>13}" for value in row[1:]))
