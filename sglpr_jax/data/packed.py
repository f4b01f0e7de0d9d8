"""Packs of recordings: the arrays of all scans, concatenated in files that are mapped into memory."""

import contextlib
import hashlib
import json
import math
import mmap
import os
import zlib
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import IO, Any

import numpy as np

from sglpr_jax.data.formats.png import image_scan
from sglpr_jax.data.recording import Recording
from sglpr_jax.data.scan import Scan
from sglpr_jax.files import file_name, in_short, read_json, replacing

FORMAT = "sglpr-jax packed recording 1"
ABOUT_FILE = "pack.json"
LAYOUT = {"points": ("<f4", [3]), "labels": ("<u2", []), "images": ("<f4", None)}
"""Type and shape of the rows of each array. Images of different packs have different widths."""


class Stacked:
    """Arrays in a file that is mapped into memory: array i is rows `offsets[i]` to `offsets[i + 1]`."""

    def __init__(self, path: Path, dtype: str, row: Sequence[int], offsets: Sequence[int], checksums: Sequence[int]):
        """Map a file and its layout as returned by `_write_arrays`.

        Raises ValueError if the layout contradicts the file. Access beyond the end of the file would kill the process.
        """
        if any(type(n) is not int for n in (*offsets, *row)) or sorted(offsets) != [*offsets] or offsets[0] != 0:
            raise ValueError(f"{path.name}: expected offsets in ascending order from 0, found {offsets!s:.60}")
        if [type(checksum) for checksum in checksums] != [int] * (len(offsets) - 1):
            raise ValueError(f"{path.name}: expected {len(offsets) - 1} checksums, found {checksums!s:.60}")
        shape = (offsets[-1], *row)
        expected_bytes = np.dtype(dtype).itemsize * math.prod(shape)
        if (found_bytes := path.stat().st_size) != expected_bytes:
            raise ValueError(f"{path.name}: expected {expected_bytes} bytes, found {found_bytes}")
        self._path, self._offsets, self._checksums = path, offsets, checksums
        with path.open("rb") as stream:
            self._file = mmap.mmap(stream.fileno(), 0, access=mmap.ACCESS_READ)
        self._rows = np.frombuffer(self._file, dtype).reshape(shape)

    def __len__(self) -> int:
        return len(self._offsets) - 1

    def __getitem__(self, i: int) -> np.ndarray:
        """Return array `i` as a read-only view. Raises ValueError if its checksum is wrong."""
        array = self._rows[slice(*self._offsets[i : i + 2])]
        if len(array):  # request all bytes at once: by default, the system reads 128 KiB at each first access
            start = self._offsets[i] * self._rows.strides[0]
            page_start = start - start % mmap.PAGESIZE
            self._file.madvise(mmap.MADV_WILLNEED, page_start, start + array.nbytes - page_start)
        if self._checksums[i] != (found := _checksum(array)):
            raise ValueError(
                f"{self._path}: expected array {i} with the checksum {self._checksums[i]} of pack.json, found {found};"
                " delete its folder to pack the recording again"
            )
        return array


def _checksum(array: np.ndarray) -> int:
    """CRC-32 of type, shape and content of an array: 0.2 ms for a scan of 120,000 points."""
    return zlib.crc32(array.data, zlib.crc32(f"{array.dtype.str} {array.shape}".encode()))


def packed(recording: Recording, folder: Path, *, on_progress: Callable[[int], None] = lambda done: None) -> Recording:
    """Return the same recording, read from its pack in `folder`. If there is no pack, it is created first.

    Points, labels and images are bitwise equal to those of the files, and read-only. Lasers are left out. The labels of
    images still come from the files. `on_progress` is called with the number of packed scans.

    Raises ValueError if the pack is damaged, or if `recording` does not return the content of its files (`on_disk`).
    """
    if not recording.on_disk:
        raise ValueError(
            f"sequence {recording.name}: expected a recording whose scans are files, found another one: a bag, a point "
            "cloud map, or a packed, changed or simulated recording"
        )
    source = _source(recording)
    identity = hashlib.sha256(json.dumps(source).encode()).hexdigest()[:16]
    target = folder / f"{file_name(recording.name)}-{identity}"
    if not target.is_dir():
        with replacing(target, keep=True) as temporary:  # If another process is faster, its pack stays.
            temporary.mkdir()
            layouts = _write_arrays(temporary, recording, on_progress)
            with (temporary / ABOUT_FILE).open("w") as stream:
                json.dump({**source, "arrays": layouts}, stream)
                _sync(stream)
    arrays = open_pack(target, scans=len(recording))

    def read_row(row: int, label_path: Path | None) -> Scan:
        if "images" in arrays:
            return image_scan(recording.paths[row], label_path, read=lambda path: arrays["images"][row])
        labels = arrays["labels"][row].astype(np.int32) if label_path is not None and "labels" in arrays else None
        return Scan(points=arrays["points"][row], labels=labels)

    return recording.with_reader(read_row)


def _source(recording: Recording) -> dict[str, Any]:
    """Values whose hash identifies the pack of a recording: its files, with size and time, and its read options."""
    paths = recording.paths if recording.has_images else (*recording.paths, *recording.label_paths)
    files = [(str(path.absolute()), path.stat()) for path in paths if path is not None]
    return {
        "format": FORMAT,
        "options": recording.read_options,
        "files": [(path, stat.st_size, stat.st_mtime_ns) for path, stat in files],
    }


def _write_arrays(folder: Path, recording: Recording, on_progress: Callable[[int], None]) -> dict[str, Any]:
    """Concatenate the arrays of all scans or images in a file `NAME.bin` for each name, such as `points.bin`.

    Returns the layout of each file by name: the arguments of `Stacked` other than the path.
    """
    streams: dict[str, IO] = {}
    layouts: dict[str, Any] = {}
    with contextlib.ExitStack() as opened:
        for i in range(len(recording)):
            for name, array in _arrays(recording, i).items():
                row_shape = array.shape[1:]
                layout = {"dtype": array.dtype.str, "row": row_shape, "offsets": [0], "checksums": []}
                layout = layouts.setdefault(name, layout)
                if (layout["dtype"], layout["row"]) != (array.dtype.str, row_shape):
                    raise ValueError(
                        f"scan {recording.ids[i]} of sequence {recording.name}: expected {layout['dtype']} with rows "
                        f"of shape {layout['row']}, like the first array of the pack, found {array.dtype} {row_shape}"
                    )
                array = np.ascontiguousarray(array)
                if name not in streams:
                    streams[name] = opened.enter_context((folder / f"{name}.bin").open("xb"))
                streams[name].write(array.data)
                layout["checksums"].append(_checksum(array))
                layout["offsets"].append(layout["offsets"][-1] + len(array))
            on_progress(i + 1)
        for stream in streams.values():
            _sync(stream)
    return layouts


def _sync(stream: IO) -> None:
    """Flush a file to disk. If its folder were renamed before, a power failure could leave an incomplete pack."""
    stream.flush()
    os.fsync(stream.fileno())


def _arrays(recording: Recording, i: int) -> dict[str, np.ndarray]:
    """Arrays of scan or image `i` by their name in a pack. A scan without labels has an empty array of labels."""
    if recording.has_images:
        return {"images": recording.image(i)}
    scan = recording.scan(i)
    if not recording.has_labels:
        return {"points": scan.cloud}
    labels = np.zeros(0, np.uint16) if scan.labels is None else scan.labels.astype(np.uint16)
    return {"points": scan.cloud, "labels": labels}


def open_pack(folder: Path, *, scans: int | None = None) -> dict[str, Stacked]:
    """Return the arrays of a pack by name. Raises ValueError if the pack is damaged or has not this number of scans."""
    try:
        layouts = read_json(folder / ABOUT_FILE)["arrays"]
        for name, layout in layouts.items():
            dtype, row = LAYOUT.get(name, (None, None))
            if layout["dtype"] != dtype or (row is not None and layout["row"] != row) or len(layout["row"]) > 1:
                raise ValueError(f"expected arrays {', '.join(LAYOUT)}, found {name!r:.20} {layout['dtype']!r:.20}")
            if scans is not None and len(layout["offsets"]) != scans + 1:
                raise ValueError(f"expected {scans} scans, found {len(layout['offsets']) - 1}")
        if "images" not in layouts and "points" not in layouts:
            raise ValueError(f"expected arrays of points or images, found {', '.join(layouts) or 'none'}")
        return {name: Stacked(folder / f"{name}.bin", **layout) for name, layout in layouts.items()}
    except (ValueError, KeyError, TypeError, AttributeError, IndexError, OSError) as error:
        raise ValueError(
            f"{folder}: expected a packed recording, found a damaged one ({ABOUT_FILE}: {in_short(error)}); delete the "
            "folder to pack the recording again"
        ) from error
