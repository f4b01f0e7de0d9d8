"""Descriptor files of a method and a corruption, reused only if they were made with the same settings."""

import contextlib
import dataclasses
import hashlib
import json
from pathlib import Path
from typing import Any, Literal

import numpy as np

from sglpr_jax.data.corruption import CLEAN, ROTATION, Corruption, corrupted
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
    corruption: Corruption,
    *,
    seed: int,
    batch: int,
    title: str = "",
    progress: Progress = no_progress,
) -> DescriptorFile:
    """Describe the corrupted recording and write the descriptor file. If the file exists, read it instead.

    Arguments:
      path: Descriptor file.
      method: Method that describes the scans.
      recording: Recording without corruption.
      corruption: Corruption of the scans.
      seed: Seed of the corruption.
      batch: Number of scans that a model describes at a time.
      title: Title of the progress display.
      progress: Progress display.

    Raises:
      ValueError: If the existing file was made with other settings, scans or weights.
    """
    wanted = _settings(method, recording, corruption, seed)
    if path.exists():
        return _checked(path, wanted)
    rotated = corruption == ROTATION
    source = recording if rotated or corruption == CLEAN else corrupted(recording, corruption, seed=seed)
    with progress(title, len(recording)) as show:
        file = embed(method, source, rotation_seed=seed if rotated else None, batch=batch, on_progress=show)
    file = dataclasses.replace(file, config={**file.config, SETTINGS: wanted})
    file.save(path)
    return file


def fingerprint(recording: Recording, *, contents: Literal["none", "some", "all"] = "none") -> str:
    """Hash a recording: ids, files, read options, mounting, positions and times.

    Files of scans and labels, or those of a bag, count by their size and modification time. Sizes and times may agree
    by chance, so with `contents="some"` the bytes of the first, the middle and the last scan count, too. With "all" the
    bytes of all files count instead. Copies then have equal hashes.
    """
    state = _content if contents == "all" else _state
    files = (recording.containers or recording.paths, recording.label_paths)
    scans, labels = ([None if path is None or not path.is_file() else state(path) for path in paths] for paths in files)
    mounting = None if recording.mounting is None else recording.mounting.fields
    digest = hashlib.sha256(json.dumps([recording.ids, scans, labels, recording.read_options, mounting]).encode())
    each = None
    if recording.mountings is not None:
        each = np.array([(one.height_m, *one.up) for one in recording.mountings])
    for values in (recording.positions, recording.times, each):
        if values is not None:
            digest.update(values.tobytes())
    if contents == "some" and len(recording):
        for row in sorted({0, len(recording) // 2, len(recording) - 1}):
            digest.update(_scan_bytes(recording, row))
    return digest.hexdigest()[:16]


def _state(path: Path) -> tuple[int, int]:
    """Size and modification time of a file."""
    found = path.stat()
    return found.st_size, found.st_mtime_ns


def _content(path: Path) -> str:
    """Hash of the bytes of a file."""
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


def _settings(method: Method, recording: Recording, corruption: Corruption, seed: int) -> dict[str, Any]:
    settings = {
        "seed": None if corruption == CLEAN else seed,
        "scans": fingerprint(recording),
        "poses": recording.pose_source,
        "corruption": dataclasses.asdict(corruption),
        "weights": method.weights_hash,
        "method": method.about,
    }
    return json.loads(json.dumps(settings))  # Tuples become lists, as in a file.


def _checked(path: Path, wanted: dict[str, Any]) -> DescriptorFile:
    file = DescriptorFile.load(path)
    stored = file.config.get(SETTINGS)
    found = stored if isinstance(stored, dict) else {}
    for name in {**wanted, **found}:
        if name not in found or name not in wanted or found[name] != wanted[name]:
            raise ValueError(
                f"{path}: expected descriptors made with {name} {json_in_short(wanted.get(name))}, found "
                f"{json_in_short(found.get(name))}; choose another --out, or delete the file"
            )
    return file
