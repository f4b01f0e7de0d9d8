"""Files and folders written whole or not at all, JSON and arrays read back, and errors that name their file."""

import contextlib
import errno
import fcntl
import functools
import json
import os
import re
import shutil
import time
import uuid
import zipfile
from collections.abc import Collection, Iterator
from pathlib import Path
from typing import Any

import numpy as np

ABANDONED_S = 3600
"""What was half-written so long ago, and nobody adds to, is left from a process that was killed."""


class WriteError(OSError):
    """A file cannot be written; the message names it."""


@contextlib.contextmanager
def replacing(path: Path, *, keep: bool = False) -> Iterator[Path]:
    """Write `path`, a file or a folder, whole or not at all.

    The block writes to the path that it is given, a hidden one beside `path`. At the end of the block this takes the
    place of `path`; after an error it is removed, and what was at `path` stays. Folders missing above `path` are made.
    With `keep` a folder that somebody else has put at `path` meanwhile stays too. What processes that were killed an
    hour ago or more have left beside `path` is removed. Raises WriteError where `path` cannot be written.

    Example:
      with replacing(path) as temporary:
          temporary.write_bytes(content)
    """
    temporary = _hidden(path)
    try:
        with writing(path, temporary, *path.parents):
            path.parent.mkdir(parents=True, exist_ok=True)
            _sweep(path.parent.resolve())
            yield temporary
            _put(temporary, path, keep=keep)
    finally:
        _remove(temporary)


def check_holds_only(folder: Path, names: Collection[str]) -> None:
    """Raise FileExistsError where a folder that is to be replaced holds anything but files of these names."""
    others = sorted({path.name for path in folder.iterdir()} - set(names)) if folder.is_dir() else []
    if others:
        raise FileExistsError(
            f"{folder}: expected a new folder, or one with {', '.join(names)} alone, which is replaced, "
            f"found {others[0]}{' and more' if len(others) > 1 else ''}"
        )


@contextlib.contextmanager
def alone_in(folder: Path) -> Iterator[None]:
    """Keep other processes out of a folder that exists, as far as they ask.

    The lock goes with the process, however that ends, and leaves nothing behind. Raises BlockingIOError where another
    process has it. On a disk that knows no locks there is none.
    """
    held = os.open(folder, os.O_RDONLY)
    try:
        try:
            fcntl.flock(held, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            raise BlockingIOError(f"{folder}: expected to be alone in it, found another process at work") from error
        except OSError:  # no locks here
            pass
        yield
    finally:
        os.close(held)


def write_text(path: Path, text: str) -> None:
    """Write a text file whole or not at all. Raises WriteError where it cannot be written."""
    with replacing(path) as temporary:
        temporary.write_text(text)


def write_json(path: Path, value: Any) -> None:
    """Write a JSON file whole or not at all. Raises WriteError where it cannot be written."""
    write_text(path, json.dumps(value, indent=2) + "\n")


def read_json(path: Path) -> Any:
    """Read a JSON file. Raises FileNotFoundError, or ValueError where it is damaged; both name the file."""
    if not path.is_file():
        raise FileNotFoundError(f"{path}: expected a JSON file, found none")
    return parse_json(path.read_bytes(), source=path)


def parse_json(text: str | bytes, *, source: Path | str) -> Any:
    """What JSON says. Raises ValueError, naming `source`, where it is none or gives one name twice."""
    try:
        return json.loads(text, object_pairs_hook=_without_doubles)
    except (ValueError, RecursionError) as error:  # not JSON, not even text, or brackets without end
        raise ValueError(f"{source}: expected JSON, found none that is whole ({in_short(error)})") from error


def _without_doubles(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    names = [name for name, _ in pairs]
    if len(set(names)) < len(names):
        raise ValueError(f"{next(name for name in names if names.count(name) > 1)!r} stands there twice")
    return dict(pairs)


def read_arrays(path: Path, *, expected: str) -> dict[str, np.ndarray]:
    """Every array of an .npz file, without pickle.

    Raises FileNotFoundError, or ValueError naming the file and what was `expected`, where it is none or damaged.
    """
    expected = f"{path}: expected {expected}"
    if not path.is_file():
        raise FileNotFoundError(f"{expected}, found no such file")
    if not zipfile.is_zipfile(path):
        raise ValueError(f"{expected}, found {path.stat().st_size} bytes that are no whole .npz archive")
    try:
        with path.open("rb") as stream, np.load(stream, allow_pickle=False) as archive:
            arrays = {name: archive[name] for name in archive.files}
    except MemoryError as error:  # a header that promises more than there is
        raise ValueError(f"{expected}, found a broken one: an array larger than the memory") from error
    except Exception as error:  # zip, zlib, numpy's header parser: each has kinds of its own
        raise ValueError(f"{expected}, found a broken one: {in_short(error)}") from error
    strange = next((name for name, array in arrays.items() if not isinstance(array, np.ndarray)), None)
    if strange is not None:  # numpy gives what is no array as bytes
        raise ValueError(f"{expected}, found a file {strange!r} that is no array")
    return arrays


def in_short(error: Exception) -> str:
    """What an error of another library says, on one line of at most 100 characters."""
    return _cut(" ".join(str(error).split()) or type(error).__name__, most=100)


def json_in_short(value: Any) -> str:
    """A value as JSON has it, a text without quotes, in at most 80 characters."""
    return _cut(value if isinstance(value, str) else json.dumps(value), most=80)


def _cut(text: str, *, most: int) -> str:
    return text if len(text) <= most else f"{text[: most - 3]}..."


@contextlib.contextmanager
def writing(path: Path, *others: Path) -> Iterator[None]:
    """Raise WriteError for an OSError of the block that names no file, as that of a full disk, or one of `others`."""
    try:
        yield
    except WriteError:
        raise
    except OSError as error:
        if error.filename is not None and Path(str(error.filename)) not in others:
            raise
        raise WriteError(f"{path}: expected to write it, found: {error.strerror or error}") from error


def half_written(folder: Path, name: str = "*") -> list[Path]:
    """What processes that were killed inside `replacing` left, of files called `name`, in `folder` and below."""
    return list(folder.rglob(f".{name}.*.tmp"))


def remove_half_written(folder: Path) -> None:
    """Remove what processes that were killed inside `replacing` left in `folder` and below."""
    for left in half_written(folder):
        _remove(left)


def _hidden(path: Path) -> Path:
    return path.with_name(f".{path.name}.{uuid.uuid4().hex}.tmp")  # no process id: several hosts share a disk


@functools.cache
def _sweep(folder: Path) -> None:
    """Remove, once in the life of this process, what others that were killed have left in a folder."""
    for left in folder.glob(".*.tmp"):
        with contextlib.suppress(FileNotFoundError):  # another process sweeps too
            newest = max(path.stat().st_mtime for path in (left, *left.rglob("*")))
            if re.search(r"\.[0-9a-f]{32}\.tmp$", left.name) and time.time() - newest > ABANDONED_S:
                _remove(left)


def _put(new: Path, path: Path, *, keep: bool) -> None:
    """Give `new` the name `path`; another process may be doing the same."""
    while True:
        try:
            return os.replace(new, path)
        except OSError as error:
            if error.errno not in (errno.ENOTEMPTY, errno.EEXIST):  # a folder replaces none that holds files
                raise
        if keep:
            return
        old = _hidden(path)
        with contextlib.suppress(FileNotFoundError):  # the other process was faster
            os.replace(path, old)
        _remove(old)


def _remove(path: Path) -> None:
    if path.is_dir():
        shutil.rmtree(path, ignore_errors=True)
    else:
        with contextlib.suppress(OSError):  # it is gone where all went well; its folder may be none
            path.unlink()
