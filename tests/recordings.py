"""Recordings for the tests: points and images in memory, labels in files. Also lists entities of a file for rerun."""

import dataclasses
import subprocess
import sys
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from sglpr_jax.data.formats.png import image_scan
from sglpr_jax.data.formats.pose_files import read_kitti, read_times
from sglpr_jax.data.formats.scan_files import read_labels
from sglpr_jax.data.recording import Recording
from sglpr_jax.data.scan import Scan


def of_scans(clouds: Mapping[Path, np.ndarray], **fields: Any) -> Recording:
    """Scans (n, 3) by the paths that they are said to have."""
    return _recording(tuple(clouds), reading_scans(clouds.__getitem__), **fields)


def of_images(images: Mapping[Path, np.ndarray], **fields: Any) -> Recording:
    """Ready-made images (h, w) by the paths that they are said to have."""

    def read(path: Path, labels: Path | None) -> Scan:
        return image_scan(path, labels, read=images.__getitem__)

    return _recording(tuple(images), read, **{"resolution_m": 0.4, **fields})


def reading_scans(points_of: Callable[[Path], np.ndarray]) -> Callable[..., Scan]:
    """What reads records of scans whose points a function of the path returns."""

    def read(path: Path, labels: Path | None) -> Scan:
        points = points_of(path)
        return Scan(points=points, labels=None if labels is None else read_labels(labels, points=len(points)))

    return read


def with_points(recording: Recording, points_of: Callable[[Path], np.ndarray]) -> Recording:
    """The recording with other points."""
    return dataclasses.replace(recording, read=reading_scans(points_of))


def _recording(paths: tuple[Path, ...], read: Callable[..., Scan], **fields: Any) -> Recording:
    named = {"name": "08", "ids": tuple(path.stem for path in paths)}
    return Recording(**{**named, **fields}, paths=paths, read=read)


def kitti_trajectory(root: Path, name: str, *, pose_source: str) -> tuple[np.ndarray, np.ndarray | None, str]:
    """Positions (n, 3) of all frames of a sequence in KITTI's layout, their times, and the name of the pose file."""
    file = f"poses/{name}.txt" if pose_source == "kitti" else f"sequences/{name}/poses.txt"
    times = root / "sequences" / name / "times.txt"
    return read_kitti(root / file)[:, :3, 3], read_times(times) if times.is_file() else None, file


def entities(path: Path) -> set[str]:
    """Entities of a file for the rerun viewer, as the program of rerun lists them."""
    command = [sys.executable, "-m", "rerun", "rrd", "print", str(path)]
    run = subprocess.run(command, capture_output=True, text=True, check=True)
    return {word for line in run.stdout.splitlines() for word in line.replace("`", " ").split() if word.startswith("/")}
