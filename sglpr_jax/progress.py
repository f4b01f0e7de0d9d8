"""Progress of long work. Functions of the library receive a `Progress`, by default one that prints nothing."""

import contextlib
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager

from sglpr_jax.files import printable

Progress = Callable[[str, int], AbstractContextManager[Callable[[int], None]]]
"""Function of a title and a total amount of work. It returns a context manager whose value is a function: the work
calls it with the amount that is done."""

PLAIN_EVERY_S = 10.0
"""Time between two lines of progress without a terminal, in seconds."""


@contextlib.contextmanager
def no_progress(title: str, total: int) -> Iterator[Callable[[int], None]]:
    """`Progress` that shows nothing."""
    yield lambda done: None


@contextlib.contextmanager
def progress_bar(title: str, total: int) -> Iterator[Callable[..., None]]:
    """`Progress` that shows a bar on stderr or, if stderr is no terminal, a line every `PLAIN_EVERY_S` seconds.

    The function of the amount done also accepts a text to show after the bar.
    """
    from rich.console import Console  # slow imports, not needed without a bar
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

    console, text_column = Console(stderr=True), TextColumn("{task.fields[text]}")
    columns = TextColumn("{task.description}", markup=False), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn()
    title = printable(title)
    if not console.is_terminal:
        yield _plain_lines(title, total)
        return
    with Progress(*columns, text_column, console=console) as progress:
        task = progress.add_task(title, total=total, text="")
        yield lambda done, text="": progress.update(task, completed=done, text=text)


def _plain_lines(title: str, total: int) -> Callable[..., None]:
    """Return a function of the amount done and a text, which prints a line on stderr now and then."""
    printed_s = time.monotonic()

    def show(done: int, text: str = "") -> None:
        nonlocal printed_s
        if time.monotonic() - printed_s >= PLAIN_EVERY_S:
            printed_s = time.monotonic()
            print(f"{title}: {done} of {total} {text}".rstrip(), file=sys.stderr, flush=True)

    return show
