"""Common parts of all commands: command line, compilation cache, one-line errors."""

import contextlib
import dataclasses
import functools
import gc
import inspect
import io
import json
import logging
import os
import re
import sys
import tempfile
import warnings
import webbrowser
from collections.abc import Callable
from importlib.metadata import distribution
from pathlib import Path
from typing import Annotated, TypeVar

import tyro
from rich.console import Console

from sglpr_jax.cli.config_file import ConfigFlags, all_flags, flag_values, hide_nested, split_settings
from sglpr_jax.fields import check_value, has_bounds
from sglpr_jax.files import DataWarning, in_short, printable

_TABLE_WIDTH = 140
INSTALLED_AS = "sglpr-"
"""Prefix of the commands that `pip install` creates."""
_ALLOCATIONS_PER_COLLECTION = 100_000
"""Allocations between garbage collections. Imports and tracing create permanent objects; with Python's default of 700,
the collections took an eighth of the start-up time."""
_BROKEN_PIPE_STATUS = 141
"""Exit status after a write to a pipe without a reader, as in shells (128 + SIGPIPE)."""
_MAX_ERROR_LENGTH = 2000
"""Maximum number of characters of an error message. File names and tables may contain long names."""
COMPILATION = "/jax/compilation_cache/compile_requests_use_cache"
"""Event of JAX before it compiles a program, or reads it from the cache."""
T = TypeVar("T")


def cache_folder() -> Path:
    """Return the user's folder for compiled programs and simulated recordings.

    A user without a home folder, as in some containers, gets a temporary folder that ends with the process.
    """
    try:
        return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "sglpr-jax"
    except RuntimeError:  # the user has no home folder
        return Path(_temporary_folder().name)


_temporary_folder = functools.cache(functools.partial(tempfile.TemporaryDirectory, prefix="sglpr-jax-"))


def with_installed_names(text: str) -> str:
    """Replace names of commands by those that `pip install` creates, if this command is one: bin/embed by sglpr-embed.

    Paths stay unchanged: /home/me/bin/embed, bin/08.npz, bin/map/08.npz.
    """
    if not Path(sys.argv[0]).name.startswith(INSTALLED_AS):
        return text
    scripts = distribution("sglpr-jax").entry_points.select(group="console_scripts")
    names = "|".join(re.escape(script.name.removeprefix(INSTALLED_AS)) for script in scripts)
    return re.sub(rf"(?<![\w/.~-])bin/({names})(?![\w/-]|\.\w)", rf"{INSTALLED_AS}\1", text)


def parse_command(command: type[T], name: str, arguments: list[str] | None = None) -> T:
    """Parse the flags of a command. With --dump-config, print their values and exit.

    Flags override the file of --config, the file overrides the preset, and the preset overrides the defaults. Raises
    ValueError if a number is outside the bounds of its annotation (`fields.py`), or if the file is invalid.

    Arguments:
      command: Dataclass of the command.
      name: Name of the command in `bin/`.
      arguments: Command line without the name. None: that of this process.
    """
    command_line_type = dataclasses.make_dataclass(
        "Line",
        [("command", Annotated[command, tyro.conf.arg(name="")]), ("common", tyro.conf.OmitArgPrefixes[ConfigFlags])],
    )
    description = inspect.getdoc(command) or ""
    defaults, arguments = split_settings(command, arguments)
    if hasattr(defaults, "config"):
        from sglpr_jax.training.presets import preset_names  # slow import, not needed by most commands

        description += f"\n\nPresets: {', '.join(preset_names())}"
    hide_nested(defaults)
    parsed = tyro.cli(
        command_line_type,
        args=arguments,
        prog=with_installed_names(f"bin/{name}"),
        description=with_installed_names(description),
        default=command_line_type(defaults, ConfigFlags()),
    )
    for flag, annotation, value in all_flags(command, vars(parsed.command)):
        if has_bounds(annotation):
            check_value(value, annotation, f"--{flag}")
    if parsed.common.dump_config:
        print(json.dumps(flag_values(parsed.command), indent=2))
        sys.exit(0)
    return parsed.command


def run(parse: Callable[[], T], work: Callable[[T], object]) -> None:
    """Parse a command line and run the command, which may return its exit status.

    Invalid input gives one line on stderr and exit status 1, Ctrl-C gives 130. If the reader of the output ends early,
    as `head` does, the command ends without a message.
    """
    gc.set_threshold(_ALLOCATIONS_PER_COLLECTION)
    # Orbax raises an error for a failed checkpoint. These loggers and this warning would repeat it.
    for logger in ("absl", "asyncio"):
        logging.getLogger(logger).setLevel(logging.CRITICAL)
    warnings.filterwarnings("ignore", "coroutine .* was never awaited", RuntimeWarning)
    warnings.showwarning = _show_warning
    warnings.simplefilter("always", DataWarning)
    if sys.unraisablehook is sys.__unraisablehook__:
        sys.unraisablehook = _show_unraisable
    if isinstance(sys.stdout, io.TextIOWrapper):
        sys.stdout.reconfigure(errors="backslashreplace")  # names of files need not be UTF-8
    try:
        command = parse()
        if "JAX_COMPILATION_CACHE_DIR" not in os.environ:  # keep compiled programs for the next start
            import jax  # slow import, not needed for --help or a wrong flag

            compiled = cache_folder() / "compiled"
            jax.config.update("jax_compilation_cache_dir", str(compiled))
            jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
            _announce_first_compilation(compiled)
        exit_status = work(command)
        if isinstance(exit_status, int):
            sys.exit(exit_status)
    except BrokenPipeError:
        sys.exit(_BROKEN_PIPE_STATUS)
    except (ValueError, OSError, FloatingPointError, ImportError) as error:
        sys.exit(_error_line(error))
    except (RuntimeError, AssertionError):  # JAX raises these for a missing device
        _check_devices()
        raise
    except KeyboardInterrupt:
        sys.exit(130)
    finally:
        try:
            sys.stdout.flush()
        except BrokenPipeError:  # Python would flush again at exit, and report the error
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def _announce_first_compilation(folder: Path) -> None:
    """Print a line at the first compilation, if the folder has no programs of an earlier start."""
    if folder.is_dir() and any(folder.iterdir()):
        return
    import jax

    lines = iter([f"first start: compiling for this computer, which takes some seconds; kept in {folder}"])

    def announce(event: str, **_: object) -> None:
        if event == COMPILATION:
            for line in lines:  # at the first event only
                print(line, file=sys.stderr)

    jax.monitoring.register_event_listener(announce)


def _error_line(error: Exception) -> str:
    one_line = " ".join(str(error).split())
    return with_installed_names(f"error: {printable(one_line, most=_MAX_ERROR_LENGTH)}")


def _check_devices() -> None:
    """Exit with one line if JAX does not find the devices of JAX_PLATFORMS."""
    platforms = os.environ.get("JAX_PLATFORMS")
    if not platforms:
        return
    import jax  # slow import, not needed for --help

    try:
        jax.devices()
    except (RuntimeError, AssertionError) as error:
        reason = f"expected a device that JAX finds, found none ({in_short(error)})"
        sys.exit(_error_line(ValueError(f"JAX_PLATFORMS={platforms}: {reason}")))


def _show_warning(message, category, filename, lineno, file=None, line=None) -> None:
    """Print warnings as Python does, but warnings about data on one line."""
    if issubclass(category, DataWarning):
        print(f"warning: {message}", file=sys.stderr)
    else:
        sys.stderr.write(warnings.formatwarning(message, category, filename, lineno, line))


def _show_unraisable(unraisable) -> None:
    """Report errors as Python does, except those of the pending writes of a failed checkpoint."""
    if str(unraisable.exc_value) != "Event loop is closed":
        sys.__unraisablehook__(unraisable)


def print_error(text: str) -> None:
    """Print a line on stderr at once. A closed terminal does not end the command."""
    with contextlib.suppress(OSError):
        print(text, file=sys.stderr, flush=True)


def open_page(page: Path) -> None:
    """Open a page in the user's browser. Without a desktop, as over ssh, do nothing: the command has printed its path.

    Browsers of the terminal are not used, because they would take it over.
    """
    if sys.platform.startswith("linux") and not {"DISPLAY", "WAYLAND_DISPLAY"} & set(os.environ):
        return
    webbrowser.open(page.resolve().as_uri())


def console() -> Console:
    """Return a console for standard output. Without a terminal it is wide enough for the tables."""
    return Console(width=None if sys.stdout.isatty() else _TABLE_WIDTH, highlight=False)
