"""Recordings packed into a few large files: training reads scans at random, and a recording is thousands of files.

    DIR/08-5f0c.../pack.json    the files that were packed (path, bytes, time of change), and how the arrays lie
    DIR/08-5f0c.../points.bin   float32 x, y, z of all scans, one after another
    DIR/08-5f0c.../labels.bin   uint16 raw ids of all points, where any scan has labels: a SemanticKITTI id has 16 bits
    DIR/08-5f0c.../images.bin   in place of these two, float32 rows of ready-made images

The folder's name ends in a hash of the list of files and of the options with which they are read. So a pack never
changes, a recording of which a file has changed is packed anew, and whoever finds a pack can use it, whichever process
or host made it.
"""

import contextlib
import dataclasses
import hashlib
import json
import shutil
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from sglpr_jax.data.cache.stacked import Stacked, StackWriter, map_stacked, sync
from sglpr_jax.data.formats.label_images import read_label_image
from sglpr_jax.data.record import ReadRecord, Record
from sglpr_jax.data.recording import Recording
from sglpr_jax.files import ABANDONED_S, half_written, in_short, read_json, replacing

FORMAT = "sglpr-jax packed recording 1"
ABOUT_FILE = "pack.json"


def packed(recording: Recording, folder: Path, *, on_progress: Callable[[int], None] = lambda done: None) -> Recording:
    """The same recording, read from its pack in `folder`, which is made first where there is none.

    Points, images and labels are equal to the bit to those of the files, and read-only; lasers, and the labels of
    images, still come from the files. `recording` is as a reader opened it. `on_progress` is told how many scans are
    packed. Raises what reading raises; OSError where the pack cannot be written; ValueError where it is damaged,
    `recording` has no files of its own, or its images differ in width.
    """
    if not recording.on_disk:
        raise ValueError(
            f"sequence {recording.name}: expected a recording as it lies on disk, found one that is packed, corrupted "
            "or simulated"
        )
    source = _source(recording)
    target = folder / f"{recording.name}-{hashlib.sha256(json.dumps(source).encode()).hexdigest()[:16]}"
    if not target.is_dir():
        _make(target, recording, source, on_progress)
    return dataclasses.replace(recording, read=_reader(recording, open_pack(target)), on_disk=False)


def _reader(recording: Recording, arrays: dict[str, Stacked]) -> ReadRecord:
    """Reads from the arrays of a pack what it has; the rest from the recording's files."""
    row_of = {path: row for row, path in enumerate(recording.paths)}
    points, raw = arrays.get("points"), arrays.get("labels")

    def read(path: Path, labels: Path | None, lasers: bool) -> Record:
        row = row_of[path]
        if points is None:
            image = arrays["images"][row]
            return Record(image=image, labels=None if labels is None else read_label_image(labels, shape=image.shape))
        return Record(
            points=points[row],
            labels=None if labels is None or raw is None else raw[row].astype(np.int32),
            lasers=recording.read(path, None, True).lasers if lasers else None,
        )

    return read


def _source(recording: Recording) -> dict[str, Any]:
    """What tells whether a pack is the recording's: its files, and the options with which they are read.

    Of the options only text counts: a reader whose points depend on other files gives a hash of these as an option.
    """
    paths = recording.paths if recording.has_images else (*recording.paths, *recording.label_paths)
    files = [(str(path.absolute()), path.stat()) for path in paths if path is not None]
    return {
        "format": FORMAT,
        "options": recording.read_options,
        "files": [(path, stat.st_size, stat.st_mtime_ns) for path, stat in files],
    }


def _make(target: Path, recording: Recording, source: dict[str, Any], on_progress: Callable[[int], None]) -> None:
    """Write a pack whole or not at all."""
    _sweep(target)
    with replacing(target, keep=True) as temporary:  # where another process is faster, its copy is as good
        temporary.mkdir()
        arrays = _write_arrays(temporary, recording, on_progress)
        with (temporary / ABOUT_FILE).open("w") as stream:
            json.dump({**source, "arrays": arrays}, stream)
            sync(stream)


def _sweep(target: Path) -> None:
    """Remove what processes that were killed have left of this pack."""
    for left in half_written(target.parent, target.name):
        with contextlib.suppress(FileNotFoundError):  # another process sweeps too
            if time.time() - max(path.stat().st_mtime for path in (left, *left.iterdir())) > ABANDONED_S:
                shutil.rmtree(left)


def _write_arrays(folder: Path, recording: Recording, on_progress: Callable[[int], None]) -> dict[str, Any]:
    """Write the arrays of all scans or images, and return how they lie."""
    with contextlib.ExitStack() as opened:
        files: dict[str, StackWriter] = {}
        for i in range(len(recording)):
            for name, array in _arrays(recording, i).items():
                if name not in files:
                    files[name] = opened.enter_context(contextlib.closing(StackWriter(folder / f"{name}.bin", array)))
                files[name].append(array, of=f"scan {recording.ids[i]} of sequence {recording.name}")
            on_progress(i + 1)
        return {name: file.finish() for name, file in files.items()}


def _arrays(recording: Recording, i: int) -> dict[str, np.ndarray]:
    if recording.has_images:
        return {"images": recording.image(i)}
    record = recording.record(i)
    assert record.points is not None
    if not recording.has_labels:
        return {"points": record.points}
    labels = np.zeros(0, np.uint16) if record.labels is None else record.labels.astype(np.uint16)
    return {"points": record.points, "labels": labels}


def open_pack(folder: Path) -> dict[str, Stacked]:
    """The arrays of a pack, by name. Raises ValueError, naming the folder, where it is damaged."""
    try:
        lie = read_json(folder / ABOUT_FILE)["arrays"]
        return {name: map_stacked(folder / f"{name}.bin", **about) for name, about in lie.items()}
    except (ValueError, KeyError, TypeError, AttributeError, IndexError, OSError) as error:
        raise ValueError(
            f"{folder}: expected a packed recording, found a damaged one ({ABOUT_FILE}: {in_short(error)}); once it is "
            "removed the recording is packed anew"
        ) from error
