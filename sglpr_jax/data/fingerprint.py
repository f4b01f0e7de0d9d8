"""Hash of a recording, by which stored results recognise their recording."""

import contextlib
import hashlib
import json
from pathlib import Path
from typing import Literal

import numpy as np

from sglpr_jax.data.recording import Recording


def fingerprint(recording: Recording, *, contents: Literal["none", "some", "all"] = "none") -> str:
    """Return a hash of a recording: ids, files, read options, mounting, positions and times.

    Files are hashed by size and modification time. With `contents="some"`, the bytes of the first, the middle and the
    last scan are hashed, too, because sizes and times may agree by chance. With "all", the bytes of all files replace
    sizes and times, so that copies have equal hashes.
    """
    files = (recording.containers or recording.paths, recording.label_paths)
    file_state = _content_hash if contents == "all" else _size_and_time
    scans, labels = (
        [file_state(path) if path is not None and path.is_file() else None for path in paths] for paths in files
    )
    mounting = None if recording.mounting is None else recording.mounting.fields
    digest = hashlib.sha256(json.dumps([recording.ids, scans, labels, recording.read_options, mounting]).encode())
    mountings = None
    if recording.mountings is not None:
        mountings = np.array([(mounting.height_m, *mounting.up) for mounting in recording.mountings])
    for array in (recording.positions, recording.times, mountings):
        if array is not None:
            digest.update(array.tobytes())
    if contents == "some" and len(recording):
        for row in sorted({0, len(recording) // 2, len(recording) - 1}):
            digest.update(_scan_bytes(recording, row))
    return digest.hexdigest()[:16]


def _size_and_time(path: Path) -> tuple[int, int]:
    """Size and modification time of a file, in bytes and nanoseconds."""
    status = path.stat()
    return status.st_size, status.st_mtime_ns


def _content_hash(path: Path) -> str:
    with path.open("rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()


def _scan_bytes(recording: Recording, row: int) -> bytes:
    """Bytes of a scan's file, or its points in a bag. Empty if the scan cannot be read, which the caller reports."""
    path = recording.paths[row]
    if path.is_file():
        return path.read_bytes()
    if recording.containers:
        with contextlib.suppress(ValueError, OSError):
            return recording.points(row).tobytes()
    return b""
