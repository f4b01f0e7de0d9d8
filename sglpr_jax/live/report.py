"""Reports of a running node: one line for each kind of trouble, not one for each scan."""

import sys
import time
from collections.abc import Callable

AGAIN_S = 30.0
"""Minimum time between two lines of the same kind, in seconds."""
Report = Callable[[str, str], None]
"""Function of the kind of an event and its description. Equal kinds share a line every `AGAIN_S` seconds."""


class Reports:
    """Prints the first event of each kind at once. Later ones are counted and printed every `AGAIN_S` seconds.

    An instance is a `Report`. It may be called from several threads.
    """

    def __init__(self, write: Callable[[str], object] | None = None, *, clock: Callable[[], float] = time.monotonic):
        self.counts: dict[str, int] = {}
        """Number of events of each kind."""
        self._write, self._clock = write or _to_stderr, clock
        self._said: dict[str, tuple[float, int]] = {}

    def __call__(self, kind: str, text: str) -> None:
        """Count an event and print it, unless its kind was printed in the last `AGAIN_S` seconds."""
        count = self.counts[kind] = self.counts.get(kind, 0) + 1
        at, before = self._said.get(kind, (-AGAIN_S, 0))
        now = self._clock()
        if before and now - at < AGAIN_S:
            return
        self._said[kind] = now, count
        more = count - before - 1
        self._write(f"{text} ({more} more since the last line)" if more else text)


def _to_stderr(text: str) -> None:
    print(text, file=sys.stderr, flush=True)
