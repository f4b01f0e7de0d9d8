"""Errors of writing that name their file."""

import contextlib
from collections.abc import Iterator
from pathlib import Path


@contextlib.contextmanager
def writing(path: Path) -> Iterator[None]:
    """Name `path` in an OSError of the block that names no file: a full disk's own says only that it is full."""
    try:
        yield
    except OSError as error:
        if error.filename is not None:
            raise
        raise OSError(f"{path}: expected to write it, found: {error.strerror or error}") from error
