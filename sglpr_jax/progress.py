"""Interface for progress displays. Callers pass a function, so library calls print nothing by default."""

import contextlib
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager

Progress = Callable[[str, int], AbstractContextManager[Callable[[int], None]]]
"""Function of a title and a total amount. It returns a context manager, whose value is called with the amount done."""


@contextlib.contextmanager
def no_progress(title: str, total: int) -> Iterator[Callable[[int], None]]:
    """Show no progress."""
    yield lambda done: None
