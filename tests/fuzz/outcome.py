"""What became of a damaged file: it was refused in one good line, read rightly, or something that may never be."""

import contextlib
import signal
import traceback
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

from sglpr_jax.data.warning import DataWarning

from .damage import Damaged

LONGEST_S = 20


class Outcome(NamedTuple):
    """One of `KINDS`, and the error or result in words."""

    kind: str
    text: str


KINDS = ("refused", "right", "told", "silent", "traceback", "bad message", "new file", "hang")
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


@contextlib.contextmanager
def _limited() -> Iterator[None]:
    def stop(number, frame):
        raise Hang

    before = signal.signal(signal.SIGALRM, stop)
    signal.setitimer(signal.ITIMER_REAL, LONGEST_S)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.signal(signal.SIGALRM, before)
