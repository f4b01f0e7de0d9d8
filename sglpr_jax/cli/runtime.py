"""What every command does around its work: a compilation cache, orderly interruption, errors in one line."""

import argparse
import contextlib
import dataclasses
import functools
import gc
import inspect
import logging
import os
import re
import signal
import sys
import warnings
from collections.abc import Callable, Iterator
from importlib.metadata import distribution
from pathlib import Path
from typing import Any, TypeVar

import tyro
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from sglpr_jax.data.warning import DataWarning
from sglpr_jax.fields import check_value, field_types, has_bounds

_TABLE_WIDTH = 140
_INSTALLED_AS = "sglpr-"
"""What `pip install` puts before the names of the commands."""
_OBJECTS_BETWEEN_COLLECTIONS = 100_000
"""Imports and tracing make objects that stay: with Python's 700 an eighth of a start went by looking for garbage."""
T = TypeVar("T")


def cache_folder() -> Path:
    """Where this user's compiled programs and simulated recordings are kept."""
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "sglpr-jax"


def preset_asked_for(arguments: list[str] | None, *, default: str) -> str:
    """What --preset says, read before the other flags are, because it sets their defaults."""
    chooser = argparse.ArgumentParser(add_help=False, allow_abbrev=False)
    chooser.add_argument("--preset", default=default)
    return chooser.parse_known_args(arguments)[0].preset


def own_names(text: str) -> str:
    """`text` with the commands as whoever started this one knows them: sglpr-embed, where bin/embed is not there.

    Paths stay as they are: /home/me/bin/embed, bin/08.npz, bin/map/08.npz.
    """
    if not Path(sys.argv[0]).name.startswith(_INSTALLED_AS):
        return text
    names = "|".join(map(re.escape, _installed_commands()))
    return re.sub(rf"(?<![\w/.~-])bin/({names})(?![\w/-]|\.\w)", rf"{_INSTALLED_AS}\1", text)


@functools.cache
def _installed_commands() -> tuple[str, ...]:
    """The commands that `pip install` gives, as bin/ has them."""
    scripts = distribution("sglpr-jax").entry_points.select(group="console_scripts")
    return tuple(script.name.removeprefix(_INSTALLED_AS) for script in scripts)


def parse_command(command: type[T], name: str, arguments: list[str] | None = None, **options: Any) -> T:
    """What the flags say; the help speaks of the commands by their own names. `options` are those of `tyro.cli`.

    Raises ValueError for a number that its annotation (`fields.py`) does not allow.
    """
    about = {"prog": own_names(f"bin/{name}"), "description": own_names(inspect.getdoc(command) or ""), **options}
    found = tyro.cli(command, args=arguments, **about)
    _check_numbers(found)
    return found


def _check_numbers(command: Any) -> None:
    """Raise ValueError, which begins with the flag, for a number that is not within the bounds of its annotation."""
    for name, annotation in field_types(type(command)).items():
        if has_bounds(annotation):
            check_value(getattr(command, name), annotation, f"--{name.replace('_', '-')}")


def run(parse: Callable[[], T], work: Callable[[T], object]) -> None:
    """Parse a command line and do its work: wrong input ends in one line on stderr and exit status 1, Ctrl-C in 130."""
    gc.set_threshold(_OBJECTS_BETWEEN_COLLECTIONS)
    for chatty in ("absl", "asyncio"):  # pages about a checkpoint that failed, which orbax raises too
        logging.getLogger(chatty).setLevel(logging.CRITICAL)
    warnings.filterwarnings("ignore", "coroutine .* was never awaited", RuntimeWarning)  # the same at the very end
    warnings.showwarning = _show_warning
    warnings.simplefilter("always", DataWarning)
    if sys.unraisablehook is sys.__unraisablehook__:
        sys.unraisablehook = _show_unraisable
    try:
        command = parse()
        _keep_compiled_programs()
        work(command)
    except (ValueError, OSError, FloatingPointError, ImportError) as error:
        sys.exit(own_names(f"error: {' '.join(str(error).split())}"))
    except KeyboardInterrupt:
        sys.exit(130)


def _keep_compiled_programs() -> None:
    """For the next start; where the user has chosen a place for them, JAX has read it."""
    if "JAX_COMPILATION_CACHE_DIR" not in os.environ:
        import jax  # takes most of a second, which --help and a wrong flag need not wait for

        jax.config.update("jax_compilation_cache_dir", str(cache_folder() / "compiled"))
        jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.5)


def _show_warning(message, category, filename, lineno, file=None, line=None) -> None:
    """What Python does; of what is wrong with the data in one line."""
    if issubclass(category, DataWarning):
        print(f"warning: {message}", file=sys.stderr)
    else:
        sys.stderr.write(warnings.formatwarning(message, category, filename, lineno, line))


def _show_unraisable(unraisable) -> None:
    """What Python does, but for what a failed checkpoint leaves behind: each of its writes finds nobody waiting."""
    if str(unraisable.exc_value) != "Event loop is closed":
        sys.__unraisablehook__(unraisable)


def console() -> Console:
    """Standard output; wide enough for the tables where it is no terminal with a width of its own."""
    return Console(width=None if sys.stdout.isatty() else _TABLE_WIDTH, highlight=False)


@dataclasses.dataclass
class StopRequest:
    """Whether work was asked to stop (call it), and by which signal."""

    signal: int | None = None

    def __call__(self) -> bool:
        return self.signal is not None

    @property
    def exit_status(self) -> int:
        """130 after Ctrl-C, as shells have it; 0 after SIGTERM, for whoever ends a run so that it can go on later."""
        return 130 if self.signal == signal.SIGINT else 0


@contextlib.contextmanager
def stop_on_signal() -> Iterator[StopRequest]:
    """Turn the first Ctrl-C or SIGTERM into a request, so that work ends where nothing is lost; a second one kills."""
    request = StopRequest()

    def ask(number, _frame):
        if request():
            raise KeyboardInterrupt
        request.signal = number
        print("stopping after this step; once more to stop at once", file=sys.stderr)

    before = {number: signal.signal(number, ask) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield request
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


@contextlib.contextmanager
def progress_bar(title: str, total: int) -> Iterator[Callable[[int], None]]:
    """A bar on stderr that is told how much is done; nothing where stderr is no terminal."""
    console = Console(stderr=True)
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    with Progress(*columns, console=console, disable=not console.is_terminal) as progress:
        task = progress.add_task(title, total=total)
        yield lambda done: progress.update(task, completed=done)
