"""Drives packed into a few large files: training reads scans at random, and a drive is thousands of small files.

    DIR/08-5f0c.../pack.json    the files that were packed (path, bytes, time of change), and how the arrays lie
    DIR/08-5f0c.../points.bin   float32 x, y, z of all scans, one after another
    DIR/08-5f0c.../labels.bin   uint16 raw ids of all points, where any scan has labels: a SemanticKITTI id has 16 bits
    DIR/08-5f0c.../images.bin   in place of these two, float32 rows of ready-made images

The folder's name ends in a hash of the list of files. So a pack never changes, a drive of which a file has changed is
packed anew, and whoever finds a pack can use it, whichever process or host made it.
"""

import contextlib
import dataclasses
import hashlib
import json
import shutil
import time
import uuid
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float32, Int32

from sglpr_jax.data.sequence import Drive, ImageSequence, ScanSequence
from sglpr_jax.data.stacked import Stacked, StackWriter, map_stacked, sync
from sglpr_jax.files import writing

FORMAT = "sglpr-jax packed drive 1"
ABOUT_FILE = "pack.json"
ABANDONED_S = 3600
"""A half-made pack to which nothing was added for so long is nobody's: its process was killed."""


@dataclasses.dataclass(frozen=True, eq=False)
class PackedScans(ScanSequence):
    """Scans whose points and labels come from a pack, equal to the bit to those of their files; read-only."""

    packed_points: Stacked
    packed_labels: Stacked | None

    def points(self, i: int) -> Float32[np.ndarray, "n 3"]:
        """The points of scan `i`, as `ScanSequence.points` reads them."""
        return self.packed_points[i]

    def labels(self, i: int) -> Int32[np.ndarray, " n"] | None:
        """The raw ids of scan `i`, or None where it has no labels."""
        if self.packed_labels is None or self.label_paths[i] is None:
            return None
        return self.packed_labels[i].astype(np.int32)


@dataclasses.dataclass(frozen=True, eq=False)
class PackedImages(ImageSequence):
    """Ready-made images that come from a pack, equal to the bit to those of their files; read-only."""

    packed_images: Stacked

    def image(self, i: int) -> Float32[np.ndarray, "h w"]:
        """Image `i`, as `ImageSequence.image` reads it."""
        return self.packed_images[i]


def packed(drive: Drive, folder: Path, *, on_progress: Callable[[int], None] = lambda done: None) -> Drive:
    """The same drive, read from its pack in `folder`, which is made first where there is none.

    `drive` is as a reader opened it. `on_progress` is told how many scans are packed. Raises what reading raises;
    OSError where the pack cannot be written; ValueError where it is damaged, `drive` has no files of its own, or its
    images differ in width.
    """
    if type(drive) not in (ScanSequence, ImageSequence):
        raise ValueError(f"sequence {drive.name}: expected a drive as it lies on disk, found a {type(drive).__name__}")
    source = _source(drive)
    target = folder / f"{drive.name}-{hashlib.sha256(json.dumps(source).encode()).hexdigest()[:16]}"
    if not target.is_dir():
        _make(target, drive, source, on_progress)
    arrays = _open(target)
    same = {field.name: getattr(drive, field.name) for field in dataclasses.fields(drive)}
    if isinstance(drive, ImageSequence):
        return PackedImages(**same, packed_images=arrays["images"])
    return PackedScans(**same, packed_points=arrays["points"], packed_labels=arrays.get("labels"))


def _source(drive: Drive) -> dict[str, Any]:
    """What tells whether a pack is the drive's: its files, and the options with which they are read."""
    if isinstance(drive, ImageSequence):
        reader, paths = drive.read_image, drive.image_paths
    else:
        reader, paths = drive.read_scan, (*drive.scan_paths, *drive.label_paths)
    files = [(str(path.absolute()), path.stat()) for path in paths if path is not None]
    return {
        "format": FORMAT,
        "options": getattr(reader, "keywords", {}),
        "files": [(path, stat.st_size, stat.st_mtime_ns) for path, stat in files],
    }


def _make(target: Path, drive: Drive, source: dict[str, Any], on_progress: Callable[[int], None]) -> None:
    """Write a pack under a temporary name, then rename it: it is whole or not there."""
    _sweep(target)
    temporary = target.with_name(f".{target.name}.{uuid.uuid4().hex}.tmp")
    try:
        with writing(target):
            temporary.mkdir(parents=True)
        arrays = _write_arrays(temporary, drive, on_progress)
        with writing(target), (temporary / ABOUT_FILE).open("w") as stream:
            json.dump({**source, "arrays": arrays}, stream)
            sync(stream)
        with writing(target):
            _publish(temporary, target)
    finally:
        shutil.rmtree(temporary, ignore_errors=True)


def _publish(temporary: Path, target: Path) -> None:
    try:
        temporary.rename(target)
    except OSError:
        if not target.is_dir():  # else another process was faster, and its copy is as good
            raise


def _sweep(target: Path) -> None:
    """Remove what processes that were killed have left of this pack."""
    for left in target.parent.glob(f".{target.name}.*.tmp"):
        with contextlib.suppress(FileNotFoundError):  # another process sweeps too
            if time.time() - max(path.stat().st_mtime for path in (left, *left.iterdir())) > ABANDONED_S:
                shutil.rmtree(left)


def _write_arrays(folder: Path, drive: Drive, on_progress: Callable[[int], None]) -> dict[str, Any]:
    """Write the arrays of all scans or images, and return how they lie."""
    with contextlib.ExitStack() as opened:
        files: dict[str, StackWriter] = {}
        for i in range(len(drive)):
            for name, array in _arrays(drive, i).items():
                if name not in files:
                    files[name] = opened.enter_context(contextlib.closing(StackWriter(folder / f"{name}.bin", array)))
                files[name].append(array, of=f"scan {drive.ids[i]} of sequence {drive.name}")
            on_progress(i + 1)
        return {name: file.finish() for name, file in files.items()}


def _arrays(drive: Drive, i: int) -> dict[str, np.ndarray]:
    if isinstance(drive, ImageSequence):
        return {"images": drive.image(i)}
    points = {"points": drive.points(i)}
    if not drive.has_labels:
        return points
    labels = drive.labels(i)
    return points | {"labels": np.zeros(0, np.uint16) if labels is None else labels.astype(np.uint16)}


def _open(folder: Path) -> dict[str, Stacked]:
    try:
        lie = json.loads((folder / ABOUT_FILE).read_text())["arrays"]
        return {name: map_stacked(folder / f"{name}.bin", **about) for name, about in lie.items()}
    except (ValueError, KeyError, TypeError, OSError) as error:
        raise ValueError(
            f"{folder}: expected a packed drive, found a damaged one ({error}); once it is removed the drive is packed "
            "anew"
        ) from error
