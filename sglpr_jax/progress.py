"""Progress of long work. Library calls receive a function for it, so by default they print nothing."""

import contextlib
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager

from sglpr_jax.files import printable

Progress = Callable[[str, int], AbstractContextManager[Callable[[int], None]]]
"""Function of a title and a total amount. It returns a context manager, whose value is called with the amount done."""


@contextlib.contextmanager
def no_progress(title: str, total: int) -> Iterator[Callable[[int], None]]:
    """Show no progress."""
    yield lambda done: None


@contextlib.contextmanager
def progress_bar(title: str, total: int) -> Iterator[Callable[..., None]]:
    """Show a progress bar on stderr, or nothing without a terminal.

    The value is a function of the amount done and, optionally, a text after the bar.
    """
    from rich.console import Console  # slow imports, not needed without a bar
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

    console, title_column = Console(stderr=True), TextColumn("{task.description}", markup=False)
    columns = (
        title_column,
        BarColumn(),
        MofNCompleteColumn(),
        TimeRemainingColumn(),
        TextColumn("{task.fields[text]}"),
    )
    with Progress(*columns, console=console, disable=not console.is_terminal) as progress:
        task = progress.add_task(printable(title), total=total, text="")
        yield lambda done, text="": progress.update(task, completed=done, text=text)
