"""How long work shows how far it is: a function that is handed in, so that a library call stays quiet by itself."""

import contextlib
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager

Progress = Callable[[str, int], AbstractContextManager[Callable[[int], None]]]
"""From a title and how much there is to do to a context that gives a function, which is told how much is done."""


@contextlib.contextmanager
def no_progress(title: str, total: int) -> Iterator[Callable[[int], None]]:
    """Show nothing."""
    yield lambda done: None
