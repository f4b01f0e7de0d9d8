"""Drives of KITTI's raw data.

    2011_09_26/2011_09_26_drive_0001_sync/velodyne_points/data/0000000000.bin   scans as in KITTI odometry
    2011_09_26/2011_09_26_drive_0001_sync/velodyne_points/timestamps.txt        2011-09-26 13:02:25.951199337
    2011_09_26/2011_09_26_drive_0001_sync/oxts/data/0000000000.txt              latitude, longitude, altitude, ...

A scan may be missing: then its line of times is blank. Positions are those of the GPS (0.8 m behind the LiDAR), east,
north, up, by the dataset's Mercator projection.
"""

import math
from functools import partial
from pathlib import Path

import numpy as np
from jaxtyping import Float

from sglpr_jax.data.formats.pose_files import numbers_of
from sglpr_jax.data.listing import files_in
from sglpr_jax.data.reader import Reader
from sglpr_jax.data.record import scan_record
from sglpr_jax.data.recording import Recording
from sglpr_jax.files import in_short

EARTH_M = 6378137.0
OXTS_COLUMNS = 30


def recording_names(root: Path) -> tuple[str, ...]:
    """Return the names of the drives in `root`: a drive, a day, or a folder of days."""
    return tuple(folder.name for folder in _drives(root))


def open_recording(root: Path, name: str) -> Recording:
    """Open a drive. Scans are numbered; GPS and times are those of the same number.

    Raises FileNotFoundError without scans, ValueError where times or GPS are malformed. Without them there are none.
    """
    folder = next(folder for folder in _drives(root) if folder.name == name)
    paths = files_in(folder / "velodyne_points" / "data", ".bin")
    if not paths:
        raise FileNotFoundError(f"{folder / 'velodyne_points' / 'data'}: expected scans (*.bin), found none")
    oxts = [folder / "oxts" / "data" / f"{path.stem}.txt" for path in paths]
    has_gps = all(path.is_file() for path in oxts)
    return Recording(
        name=name,
        ids=tuple(path.stem for path in paths),
        positions=_positions(oxts) if has_gps else None,
        times=_times(folder / "velodyne_points" / "timestamps.txt", paths),
        pose_source="oxts (GPS)" if has_gps else None,
        paths=paths,
        read=partial(scan_record, format="kitti"),
        found=("format: KITTI raw",),
    )


def _drives(root: Path) -> tuple[Path, ...]:
    if not root.is_dir():
        return ()
    found = [root] if (root / "velodyne_points").is_dir() else []
    found += [path.parent for pattern in ("*", "*/*") for path in root.glob(f"{pattern}/velodyne_points")]
    return tuple(sorted((folder.resolve() for folder in found), key=lambda folder: folder.name))


def _positions(files: list[Path]) -> Float[np.ndarray, "n 3"]:
    """East, north and up of the first GPS position, metres."""
    numbers = [numbers_of(file.read_text().split(), columns=OXTS_COLUMNS, where=str(file)) for file in files]
    latitude, longitude, altitude = np.array(numbers)[:, :3].T
    scale = math.cos(math.radians(latitude[0]))
    east = scale * EARTH_M * np.radians(longitude)
    north = scale * EARTH_M * np.log(np.tan(np.radians(90 + latitude) / 2))
    positions = np.stack([east, north, altitude], axis=1)
    return positions - positions[0]


def _times(file: Path, paths: tuple[Path, ...]) -> Float[np.ndarray, " n"] | None:
    """Seconds since 1970 of these scans; None without the file."""
    if not file.is_file():
        return None
    lines = file.read_text(errors="replace").splitlines()  # also the blank ones: the line of a scan is its number
    try:
        return np.array([_seconds(lines[int(path.stem)]) for path in paths])
    except (ValueError, IndexError) as error:
        raise ValueError(
            f"{file}: expected a date and time, 2011-09-26 13:02:25.951199337, for each of {len(paths)} scans, found"
            f" {len(lines)} lines or others ({in_short(error)})"
        ) from error


def _seconds(line: str) -> float:
    """Seconds since 1970 of a date and time; ValueError for anything else."""
    stamp = np.datetime64(line.strip().replace(" ", "T"), "ns")
    if np.isnat(stamp):  # numpy's reading of a blank line
        raise ValueError(f"a scan whose line is {line.strip()!r}")
    return float(stamp.astype(np.int64) / 1e9)


READER = Reader(
    layout="DATE/DRIVE/velodyne_points/data/*.bin (KITTI raw)",
    recording_names=recording_names,
    open=lambda root, name, options: open_recording(root, name),
    rank=6,
)
