"""Packs recordings into a few large files. Training reads scans at random, and a recording has thousands of files.

- `DIR/08-5f0c.../pack.json`: the packed files (path, size, modification time) and the layout of the arrays.
- `DIR/08-5f0c.../points.bin`: float32 x, y, z of all scans, one after another.
- `DIR/08-5f0c.../labels.bin`: uint16 raw ids of all points, if any scan has labels (a SemanticKITTI id has 16 bits).
- `DIR/08-5f0c.../images.bin`: float32 rows of ready-made images, instead of points and labels.

The folder name ends in a hash of the file list and the read options, so a pack never changes. If a file of the
recording changes, the recording is packed again. Any process or host can use an existing pack.
"""

import contextlib
import dataclasses
import hashlib
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from sglpr_jax.data.cache.stacked import Stacked, StackWriter, map_stacked, sync
from sglpr_jax.data.formats.label_images import read_label_image
from sglpr_jax.data.record import ReadRecord, Record
from sglpr_jax.data.recording import Recording
from sglpr_jax.files import in_short, read_json, replacing
from sglpr_jax.names import file_name

FORMAT = "sglpr-jax packed recording 1"
ABOUT_FILE = "pack.json"
LAYOUT = {"points": ("<f4", [3]), "labels": ("<u2", []), "images": ("<f4", None)}
"""Type and shape of the rows of each array. Images of different packs have different widths."""


def packed(recording: Recording, folder: Path, *, on_progress: Callable[[int], None] = lambda done: None) -> Recording:
    """Return the same recording, read from its pack in `folder`. If there is no pack, it is created first.

    Points, labels and images are bitwise equal to those of the files. Points and images are read-only. Lasers, and the
    labels of images, still come from the files.

    Arguments:
      recording: Recording as opened by a reader.
      folder: Folder of the packs.
      on_progress: Called with the number of packed scans.

    Raises:
      ValueError: If the pack is damaged, `recording` is not read from its own files, or its images differ in width.
        Other errors are those of reading.
      OSError: If the pack cannot be written.
    """
    if not recording.on_disk:
        raise ValueError(
            f"sequence {recording.name}: expected a recording that is read from its files, found a packed, "
            "corrupted or simulated one"
        )
    source = _source(recording)
    identity = hashlib.sha256(json.dumps(source).encode()).hexdigest()[:16]
    target = folder / f"{file_name(recording.name)}-{identity}"
    if not target.is_dir():
        _make(target, recording, source, on_progress)
    return dataclasses.replace(
        recording, read=_reader(recording, open_pack(target, scans=len(recording))), on_disk=False
    )


def _reader(recording: Recording, arrays: dict[str, Stacked]) -> ReadRecord:
    """Return a function that reads from the arrays of a pack, and everything else from the recording's files."""
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
    """Identify the pack of a recording: its files and their read options.

    Only options that are strings count. A reader whose points depend on other files adds a hash of these files as an
    option.
    """
    paths = recording.paths if recording.has_images else (*recording.paths, *recording.label_paths)
    files = [(str(path.absolute()), path.stat()) for path in paths if path is not None]
    return {
        "format": FORMAT,
        "options": recording.read_options,
        "files": [(path, stat.st_size, stat.st_mtime_ns) for path, stat in files],
    }


def _make(target: Path, recording: Recording, source: dict[str, Any], on_progress: Callable[[int], None]) -> None:
    """Write a pack atomically."""
    with replacing(target, keep=True) as temporary:  # If another process is faster, its copy stays.
        temporary.mkdir()
        arrays = _write_arrays(temporary, recording, on_progress)
        with (temporary / ABOUT_FILE).open("w") as stream:
            json.dump({**source, "arrays": arrays}, stream)
            sync(stream)


def _write_arrays(folder: Path, recording: Recording, on_progress: Callable[[int], None]) -> dict[str, Any]:
    """Write the arrays of all scans or images, and return their layout."""
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


def open_pack(folder: Path, *, scans: int | None = None) -> dict[str, Stacked]:
    """Return the arrays of a pack by name.

    Raises ValueError, with the folder, if the pack is damaged, has other arrays than a pack, or not as many `scans`.
    """
    try:
        lie = read_json(folder / ABOUT_FILE)["arrays"]
        for name, about in lie.items():
            _check_layout(name, about, scans)
        if "images" not in lie and "points" not in lie:
            raise ValueError(f"expected arrays of points or images, found {', '.join(lie) or 'none'}")
        return {name: map_stacked(folder / f"{name}.bin", **about) for name, about in lie.items()}
    except (ValueError, KeyError, TypeError, AttributeError, IndexError, OSError) as error:
        raise ValueError(
            f"{folder}: expected a packed recording, found a damaged one ({ABOUT_FILE}: {in_short(error)}); delete the "
            "folder to pack the recording again"
        ) from error


def _check_layout(name: str, about: dict[str, Any], scans: int | None) -> None:
    """Raise ValueError if a pack has no array of this name, type and shape of its rows."""
    dtype, row = LAYOUT.get(name, (None, None))
    if about["dtype"] != dtype or (row is not None and about["row"] != row) or len(about["row"]) > 1:
        raise ValueError(f"expected arrays {', '.join(LAYOUT)}, found {name!r:.20} {about['dtype']!r:.20}")
    if scans is not None and len(about["offsets"]) != scans + 1:
        raise ValueError(f"expected {scans} scans, found {len(about['offsets']) - 1}")
