"""Descriptor files that are reused if they were made with the same settings, and hashes of recordings."""

import contextlib
import dataclasses
import hashlib
import json
from pathlib import Path
from typing import Any, Literal

import numpy as np

from sglpr_jax.data.corruption import CLEAN, ROTATION
from sglpr_jax.data.recording import Recording
from sglpr_jax.files import json_in_short
from sglpr_jax.methods.method import Method
from sglpr_jax.progress import Progress, no_progress
from sglpr_jax.retrieval.descriptor_file import DescriptorFile
from sglpr_jax.retrieval.embed import embed

SETTINGS = "made_with"
"""Key of the settings in the `config` of a descriptor file."""


def embed_or_reuse(
    path: Path,
    method: Method,
    recording: Recording,
    *,
    rotation_seed: int | None = None,
    batch: int,
    title: str = "",
    progress: Progress = no_progress,
) -> DescriptorFile:
    """Describe a recording and write the descriptor file. If the file exists, read it instead.

    Arguments:
      path: Descriptor file.
      method: Method that describes the scans.
      recording: The scans.
      rotation_seed: With a seed, every scan is first rotated about z by its own random angle.
      batch: Number of scans that a model describes at a time.
      title: Title of the progress display.
      progress: Progress display.

    Raises ValueError if the existing file was made with other settings, scans or weights.
    """
    settings = {
        "seed": rotation_seed,
        "scans": fingerprint(recording),
        "poses": recording.pose_source,
        "corruption": dataclasses.asdict(CLEAN if rotation_seed is None else ROTATION),
        "weights": method.weights_hash,
        "method": method.about,
    }
    settings = json.loads(json.dumps(settings))  # tuples become lists, as in a file
    if path.exists():
        file = DescriptorFile.load(path)
        _check_settings(path, file.config.get(SETTINGS), settings)
        return file
    with progress(title, len(recording)) as show:
        file = embed(method, recording, rotation_seed=rotation_seed, batch=batch, on_progress=show)
    file = dataclasses.replace(file, config={**file.config, SETTINGS: settings})
    file.save(path)
    return file


def _check_settings(path: Path, stored: Any, wanted: dict[str, Any]) -> None:
    """Raise ValueError if the settings stored in a descriptor file differ from the wanted ones. Names the first one."""
    stored = stored if isinstance(stored, dict) else {}
    for name in {**wanted, **stored}:
        if name not in stored or name not in wanted or stored[name] != wanted[name]:
            raise ValueError(
                f"{path}: expected descriptors made with {name} {json_in_short(wanted.get(name))}, found "
                f"{json_in_short(stored.get(name))}; choose another --out, or delete the file"
            )


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
