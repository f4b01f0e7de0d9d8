"""Checksums of a checkpoint's files. They detect damaged weights before training continues with them."""

import hashlib
from collections.abc import Iterator
from pathlib import Path

from sglpr_jax.files import read_json, write_json

CHECKSUMS_FILE = "checksums.json"
"""File in the checkpoint's folder with the SHA-256 of every file by its path."""
NOT_COVERED = (CHECKSUMS_FILE, "_CHECKPOINT_METADATA", "commit_success.txt")
"""Files at the top of the folder without data of this package. Orbax writes the last two when all others are
complete."""


def write_checksums(folder: Path) -> None:
    """Write the checksums of all files in `folder`. Raises OSError if they cannot be written."""
    write_json(folder / CHECKSUMS_FILE, {name: _sha256(folder / name) for name in _covered(folder)})


def damage(folder: Path) -> str | None:
    """Describe the first damaged file in `folder`, or return None if all files match their checksums."""
    try:
        checksums = read_json(folder / CHECKSUMS_FILE)
        read_json(folder / "_CHECKPOINT_METADATA")
    except (ValueError, OSError) as error:
        return str(error)
    if not isinstance(checksums, dict):
        return f"{folder / CHECKSUMS_FILE}: expected a checksum for each file, found {checksums!r:.60}"
    there = set(_covered(folder))
    for name in sorted(there | set(checksums)):
        found = _sha256(folder / name) if name in there else "no such file"
        if found != checksums.get(name):
            return f"{folder / name}: expected SHA-256 {checksums.get(name, 'none')}, found {found}"
    return None


def _covered(folder: Path) -> Iterator[str]:
    for path in sorted(folder.rglob("*")):
        name = path.relative_to(folder).as_posix()
        if path.is_file() and name not in NOT_COVERED:
            yield name


def _sha256(path: Path) -> str:
    with path.open("rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()
