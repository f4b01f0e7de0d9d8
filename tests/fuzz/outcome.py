"""What became of a damaged file: it was refused in one good line, read rightly, or something that may never be."""

import contextlib
import resource
import signal
import traceback
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

from sglpr_jax.data.warning import DataWarning

from .damage import Damaged

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


def outcome(path: Path, damaged: Damaged, read: Callable[[Path], Any], same: Callable[[Any], bool]) -> Outcome:
    """Read `path`, which holds `damaged`. `same` says whether a result is that of the undamaged file."""
    before = sorted(path.parent.rglob("*"))
    found = _outcome(path, damaged, read, same)
    new = sorted(set(path.parent.rglob("*")) - set(before))
    return Outcome("new file", str(new[0])) if new else found


def _outcome(path: Path, damaged: Damaged, read: Callable[[Path], Any], same: Callable[[Any], bool]) -> Outcome:
    try:
        with _limited(), warnings.catch_warnings(record=True) as told:
            warnings.simplefilter("always", DataWarning)
            result = read(path)
    except (ValueError, OSError) as error:
        line = str(error)
        if _for_want_of_memory(error):
            return Outcome("memory", line)
        good = path.name in line and "expected" in line and "found" in line and len(line) < 1000 and "\n" not in line
        if damaged.expected == "same":
            return Outcome("bad message", f"refused what is the same: {line}")
        return Outcome("refused" if good else "bad message", line)
    except Hang:
        return Outcome("hang", f"more than {LONGEST_S} s")
    except Exception:
        return Outcome("traceback", traceback.format_exc())
    with contextlib.suppress(Exception):  # a plain parser that fails where ours did not says: it is not the same
        if damaged.expected != "refused" and same(result):
            return Outcome("right", "")
    if told and path.name in str(told[0].message):
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
