"""Atomic writing of files and folders, reading of JSON, and errors and warnings that name their file."""

import contextlib
import errno
import hashlib
import json
import os
import re
import shutil
import tempfile
import uuid
import warnings
from collections.abc import Callable, Collection, Iterator, Mapping
from pathlib import Path
from typing import Any


class WriteError(OSError):
    """A file cannot be written. The message names it."""

    def __init__(self, path: Path, reason: str):
        super().__init__(f"{path}: cannot be written: {reason}")
        self.path, self.reason = path, reason


class DataWarning(UserWarning):
    """Data can be read but looks wrong. The message names the file, what was expected and what was found."""


def warn(message: str) -> None:
    """Issue a `DataWarning` at the line that called the function which calls `warn`."""
    warnings.warn(message, DataWarning, stacklevel=3)


@contextlib.contextmanager
def replacing(path: Path, *, keep: bool = False) -> Iterator[Path]:
    """Write `path`, a file or a folder, completely or not at all. Missing parent folders are created.

    The block receives a hidden path in the same folder and writes to it. It must not call `replacing` below the hidden
    path, because `replacing` would create a removed folder again. After the block, the hidden path replaces `path`, or
    after an error it is removed. With `keep`, a folder that another process has put at `path` stays.

    Raises WriteError if `path` cannot be written.

    Example:
      with replacing(path) as temporary:
          temporary.write_bytes(content)
    """
    temporary = _hidden_path(path)
    try:
        with raising_write_error(path, temporary, *path.parents):
            path.parent.mkdir(parents=True, exist_ok=True)
            yield temporary
            _rename(temporary, path, keep=keep)
    finally:
        _remove(temporary)


def write_all(folder: Path, files: Mapping[str, Callable[[Path], object]]) -> list[Path]:
    """Write several files of a folder, and return their paths. All are complete before the first one is replaced.

    `files` has, for each file name, a function that writes the content to the path that it receives.

    Raises WriteError if a file cannot be written. All files in the folder then stay as they were.
    """
    with contextlib.ExitStack() as replacements:
        for name, write in files.items():
            write(replacements.enter_context(replacing(folder / name)))
    return [folder / name for name in files]


def check_holds_only(folder: Path, names: Collection[str]) -> None:
    """Raise FileExistsError if a folder that will be replaced holds other files than those with these names."""
    other_names = sorted({path.name for path in folder.iterdir()} - set(names)) if folder.is_dir() else []
    if other_names:
        raise FileExistsError(
            f"{folder}: expected a new folder, or one with only {', '.join(names)} (which are replaced), "
            f"found {other_names[0]}{' and more' if len(other_names) > 1 else ''}"
        )


@contextlib.contextmanager
def exclusive_lock(folder: Path) -> Iterator[None]:
    """Create a folder and lock it against other processes of this user and computer. Remove it at the end if empty.

    The lock is a file in the system's temporary folder. It ends with the process.

    Raises BlockingIOError if another process holds the lock, NotADirectoryError if a part of the path is a file.
    """
    import filelock  # slow import

    missing = [path for path in (folder, *folder.parents) if not path.exists()]
    existing = next(path for path in (folder, *folder.parents) if path.exists())
    if not existing.is_dir():
        raise NotADirectoryError(f"{existing}: expected a folder to write into, found a file")
    with raising_write_error(folder, *folder.parents):
        folder.mkdir(parents=True, exist_ok=True)
    user = str(os.getuid()) if hasattr(os, "getuid") else ""  # a lock file of another user cannot be opened
    digest = hashlib.sha256(os.fsencode(folder.resolve()) + b"\0" + user.encode()).hexdigest()[:32]
    try:
        with filelock.FileLock(Path(tempfile.gettempdir()) / f"sglpr-jax-{digest}.lock", timeout=0):
            try:
                yield
            finally:
                with contextlib.suppress(OSError):  # `rmdir` fails at the first folder that is not empty
                    for path in missing or [folder]:
                        path.rmdir()
    except filelock.Timeout as error:
        raise BlockingIOError(f"{folder}: expected exclusive use, found another process at work") from error


def append_whole(file: int, content: bytes, *, size: int) -> None:
    """Write `content` at the end of an open file of `size` bytes, completely or not at all. Raises OSError if it cannot
    be written: a full disk may take a part without an error, which is then removed."""
    rest = memoryview(content)
    try:
        os.lseek(file, size, os.SEEK_SET)
        while rest:
            rest = rest[os.write(file, rest) :]
    except OSError:
        os.ftruncate(file, size)
        raise


def write_bytes(path: Path, content: bytes) -> None:
    """Write a file, completely or not at all. Raises WriteError if it cannot be written."""
    with replacing(path) as temporary:
        temporary.write_bytes(content)


def write_text(path: Path, text: str) -> None:
    """Write a text file in UTF-8, completely or not at all. Raises WriteError if it cannot be written."""
    write_bytes(path, text_bytes(text))


def write_json(path: Path, value: Any) -> None:
    """Write a JSON file completely or not at all. Raises WriteError if it cannot be written."""
    write_text(path, json_text(value))


def text_bytes(text: str) -> bytes:
    """Encode a text in UTF-8. Characters that UTF-8 cannot encode, as in some file names, are escaped."""
    return text.encode(errors="backslashreplace")


def json_text(value: Any) -> str:
    """Return a value as indented JSON, with a line break at the end."""
    return json.dumps(value, indent=2) + "\n"


def read_json(path: Path) -> Any:
    """Read a JSON file. Raises FileNotFoundError, or ValueError if it is invalid (`parse_json`)."""
    if not path.is_file():
        raise FileNotFoundError(f"{path}: expected a JSON file, found none")
    return parse_json(path.read_bytes(), source=path)


def parse_json(text: str | bytes, *, source: Path | str) -> Any:
    """Parse JSON. Raises ValueError, naming `source`, if the text is not valid JSON or repeats a name in an object."""
    try:
        return json.loads(text, object_pairs_hook=_object_with_unique_names)
    except (ValueError, RecursionError) as error:  # not JSON, not text, or too deeply nested
        raise ValueError(f"{source}: expected JSON, found invalid JSON ({in_short(error)})") from error


def _object_with_unique_names(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    """Return the names and values of a JSON object as a dictionary. Raises ValueError if a name appears twice."""
    names = [name for name, _ in pairs]
    if len(set(names)) < len(names):
        raise ValueError(f"{next(name for name in names if names.count(name) > 1)!r} appears twice")
    return dict(pairs)


@contextlib.contextmanager
def naming(source: Path | str) -> Iterator[None]:
    """Context manager that puts the name of a file before the message of a ValueError."""
    try:
        yield
    except ValueError as error:
        raise ValueError(f"{source}: {error}") from error


def in_short(error: Exception | str, *, most: int = 100) -> str:
    """Return the message of another library's error, on one line of at most `most` characters."""
    return _shortened(" ".join(str(error).split()) or type(error).__name__, most=most)


def json_in_short(value: Any) -> str:
    """Return a value as JSON, or a text without quotes, in at most 80 characters."""
    return _shortened(value if isinstance(value, str) else json.dumps(value), most=80)


def _shortened(text: str, *, most: int) -> str:
    return text if len(text) <= most else f"{text[: most - 3]}..."


@contextlib.contextmanager
def raising_write_error(path: Path, *replaced: Path) -> Iterator[None]:
    """Context manager that raises WriteError with `path` for an OSError that names no file, as of a full disk.

    An error that names one of the paths `replaced` is converted, too. Other errors are unchanged.
    """
    try:
        yield
    except WriteError as error:
        if error.path not in replaced:
            raise
        raise WriteError(path, error.reason) from error
    except OSError as error:
        if error.filename is not None and Path(str(error.filename)) not in replaced:
            raise
        raise WriteError(path, error.strerror or str(error)) from error


def check_writable(path: Path) -> None:
    """Raise IsADirectoryError or WriteError before long work if no file can be written at `path`."""
    if path.is_dir():
        raise IsADirectoryError(f"{path}: expected a file to write, found a folder")
    existing = next(folder for folder in path.absolute().parents if folder.exists())
    trial = _hidden_path(existing / path.name)
    try:
        with raising_write_error(path, trial, *trial.parents):
            trial.touch()
    finally:
        _remove(trial)


def check_still_there(*paths: Path) -> None:
    """Raise FileNotFoundError if a written file does not exist any more, as after its folder was removed: `replacing`
    then creates the folder again, for the later files only."""
    for path in paths:
        if not path.exists():
            raise FileNotFoundError(f"{path}: expected this file, which was written before, found it removed")


def half_written(folder: Path) -> list[Path]:
    """Return the unfinished files and folders that killed processes left in `folder` and below (see `replacing`)."""
    # `Path.rglob` would raise FileNotFoundError if another process removes a folder meanwhile.
    paths = (Path(parent, name) for parent, folders, files in os.walk(folder) for name in (*folders, *files))
    return [path for path in paths if path.match(".*.tmp")]


def remove_half_written(folder: Path) -> None:
    """Remove the files and folders of `half_written`."""
    for path in half_written(folder):
        _remove(path)


def _hidden_path(path: Path) -> Path:
    """A new hidden path in the same folder. No process id, because several hosts may share a disk."""
    return path.with_name(f".{path.name}.{uuid.uuid4().hex}.tmp")


def _rename(source: Path, target: Path, *, keep: bool) -> None:
    """Rename `source` to `target`, as others may do at once. A folder at `target` is replaced, or stays with `keep`."""
    while True:
        try:
            return os.replace(source, target)
        except OSError as error:
            if error.errno not in (errno.ENOTEMPTY, errno.EEXIST):  # `target` is a folder with files
                raise
        if keep:
            return
        previous = _hidden_path(target)
        with contextlib.suppress(FileNotFoundError):  # another process has just moved the folder
            os.replace(target, previous)
        _remove(previous)


def _remove(path: Path) -> None:
    """Remove a file or folder, if it exists. Errors are ignored."""
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path, ignore_errors=True)
    else:
        with contextlib.suppress(OSError):
            path.unlink()


MOST_BYTES = 120
"""Maximum length of a file name from `file_name`, in bytes. Suffixes of temporary files need the rest of the usual
255."""
MOST_SHOWN = 100
"""Maximum number of characters of a name in messages."""
_UNSAFE = re.compile(r"[/\\\x00-\x1f\x7f]")


def file_name(name: str) -> str:
    """Return the name of the file or folder for a recording or a scan. Different names have different file names.

    A safe file name stays unchanged. In any other name, such as `../x` or a very long name, unusual characters are
    replaced and a hash is appended.
    """
    try:
        name_bytes = len(os.fsencode(name))
    except UnicodeEncodeError:  # half of a surrogate pair, as JSON may contain, is no safe name
        name_bytes = 0
    if 0 < name_bytes <= MOST_BYTES and name not in (".", "..") and not _UNSAFE.search(name):
        return name
    readable = re.sub(r"[^\w.-]", "_", name, flags=re.ASCII)[: MOST_BYTES // 2].strip(".")
    return f"{readable}-{hashlib.sha256(name.encode(errors='surrogatepass')).hexdigest()[:16]}"


def path_inside(root: Path, listed: Any, *, source: Path) -> Path:
    """Return the path of a file from its path `listed` in a table, relative to the folder `root` of the dataset.

    Raises ValueError, which names the table `source`, if `listed` is not a relative path or leads out of `root`.
    """
    path = Path(listed) if isinstance(listed, str) and "\0" not in listed else Path("..")  # ".." is rejected below
    if path.anchor or ".." in path.parts or path == Path():
        raise ValueError(f"{source}: expected paths of files inside {root}, found {listed!r:.80}")
    return root / path


def printable(name: str, *, most: int = MOST_SHOWN) -> str:
    """Return a name as one line of printable text. Other characters are escaped. A long name loses its middle."""
    shown = name if len(name) <= most else f"{name[: most - 19]}...{name[-16:]}"
    return "".join(char if char.isprintable() else char.encode("unicode_escape").decode() for char in shown)
