"""Progress of long work. Functions of the library receive a `Progress`, by default one that prints nothing."""

import contextlib
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager

from sglpr_jax.files import printable

Progress = Callable[[str, int], AbstractContextManager[Callable[[int], None]]]
"""Function of a title and a total amount of work. It returns a context manager whose value is a function: the work
calls it with the amount that is done."""


@contextlib.contextmanager
def no_progress(title: str, total: int) -> Iterator[Callable[[int], None]]:
    """`Progress` that shows nothing."""
    yield lambda done: None


@contextlib.contextmanager
def progress_bar(title: str, total: int) -> Iterator[Callable[..., None]]:
    """`Progress` that shows a bar on stderr if stderr is a terminal.

    The function of the amount done also accepts a text to show after the bar.
    """
    from rich.console import Console  # slow imports, not needed without a bar
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

    console, text_column = Console(stderr=True), TextColumn("{task.fields[text]}")
    columns = TextColumn("{task.description}", markup=False), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn()
    with Progress(*columns, text_column, console=console, disable=not console.is_terminal) as progress:
        task = progress.add_task(printable(title), total=total, text="")
        yield lambda done, text="": progress.update(task, completed=done, text=text)
