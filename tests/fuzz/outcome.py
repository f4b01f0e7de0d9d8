"""What became of a damaged file: it was refused in one good line, read rightly, or something that may never be."""

import contextlib
import re
import resource
import signal
import traceback
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

from sglpr_jax.data.warning import DataWarning

from .road import Case, FolderRoad, Road

LONGEST_S = 60
MOST_BYTES = 2**31
"""Memory that a reader may ask for, beyond that of the process."""


class Outcome(NamedTuple):
    """One of `KINDS`, and the error or result in words."""

    kind: str
    text: str


KINDS = ("refused", "right", "told", "silent", "traceback", "bad message", "new file", "hang", "memory")
ALLOWED = ("refused", "right", "told")
"""Told: read, with a warning that names the file."""


class Hang(BaseException):
    """A reader did not come back."""


def outcome(road: Road | FolderRoad, case: Case, folder: Path) -> Outcome:
    """Read the files of a case, which are in `folder`."""
    before = set(folder.rglob("*"))
    found = _outcome(road, case, folder)
    new = sorted(str(path.relative_to(folder)) for path in set(folder.rglob("*")) - before)
    new = [path for path in new if not (road.written and re.match(road.written, path))]
    return Outcome("new file", new[0]) if new else found


def _outcome(road: Road | FolderRoad, case: Case, folder: Path) -> Outcome:
    opened, damaged = folder / road.opened(case), case.damaged
    names = {opened.name, *(Path(file).name for file in (case.file, *case.beside))}
    try:
        with _limited(), warnings.catch_warnings(record=True) as told:
            warnings.simplefilter("always", DataWarning)
            result = road.read(opened)
    except (ValueError, OSError) as error:
        line = str(error)
        if _for_want_of_memory(error):
            return Outcome("memory", line)
        named = any(name in line for name in names)
        good = named and "expected" in line and "found" in line and len(line) < 1000 and "\n" not in line
        if damaged.expected == "same":
            return Outcome("bad message", f"refused what is the same: {line}")
        return Outcome("refused" if good else "bad message", line)
    except Hang:
        return Outcome("hang", f"more than {LONGEST_S} s")
    except Exception:
        return Outcome("traceback", traceback.format_exc())
    with contextlib.suppress(Exception):  # a plain parser that fails where ours did not says: it is not the same
        if damaged.expected != "refused" and road.says(result, case):
            return Outcome("right", "")
    if told and any(name in str(told[0].message) for name in names):
        return Outcome("told", str(told[0].message))
    return Outcome("silent", repr(result)[:300])


def _for_want_of_memory(error: BaseException | None) -> bool:
    """Whether an error comes from one of memory. A reader checks sizes before it asks for memory."""
    return error is not None and (isinstance(error, MemoryError) or _for_want_of_memory(error.__context__))


@contextlib.contextmanager
def _limited() -> Iterator[None]:
    """Limit time and memory."""

    def stop(number, frame):
        raise Hang

    before, memory = signal.signal(signal.SIGALRM, stop), resource.getrlimit(resource.RLIMIT_AS)
    signal.setitimer(signal.ITIMER_REAL, LONGEST_S)
    resource.setrlimit(resource.RLIMIT_AS, (_address_space() + MOST_BYTES, memory[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_AS, memory)
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.signal(signal.SIGALRM, before)


def _address_space() -> int:
    """Bytes that this process has mapped."""
    return int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
