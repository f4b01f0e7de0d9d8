"""Reader of KITTI's raw data.

- `2011_09_26/2011_09_26_drive_0001_sync/velodyne_points/data/0000000000.bin`: a scan, as in KITTI odometry.
- `2011_09_26/2011_09_26_drive_0001_sync/velodyne_points/timestamps.txt`: lines such as 2011-09-26 13:02:25.951199337.
- `2011_09_26/2011_09_26_drive_0001_sync/oxts/data/0000000000.txt`: latitude, longitude, altitude, ...

If a scan is missing, its line of the timestamps is blank. Positions are those of the GPS, 0.8 m behind the LiDAR. They
are computed with the dataset's Mercator projection, in axes east, north, up.
"""

import math
from functools import partial
from pathlib import Path

import numpy as np
from jaxtyping import Float

from sglpr_jax.data.formats.pose_files import read_rows
from sglpr_jax.data.formats.scan_files import scan_of_file
from sglpr_jax.data.readers.listing import scans_in
from sglpr_jax.data.readers.reader import Reader, ReadOptions
from sglpr_jax.data.recording import Recording
from sglpr_jax.files import in_short

EARTH_M = 6378137.0
"""Radius of the earth at the equator (WGS84), in metres."""
OXTS_COLUMNS = 30
POLE_DEG = 90.0


def recording_names(root: Path) -> tuple[str, ...]:
    """Return the names of the drives in `root`, which is a drive, a day, or a folder of days."""
    return tuple(folder.name for folder in _drives(root))


def open_recording(root: Path, name: str, options: ReadOptions) -> Recording:
    """Open a drive: scans, GPS positions (if every scan has an oxts file) and timestamps (if the file exists)."""
    folder = next(folder for folder in _drives(root) if folder.name == name)
    paths = scans_in(folder / "velodyne_points" / "data", ".bin")
    oxts_files = [folder / "oxts" / "data" / f"{path.stem}.txt" for path in paths]
    has_gps = all(path.is_file() for path in oxts_files)
    return Recording(
        name=name,
        ids=tuple(path.stem for path in paths),
        paths=paths,
        read=partial(scan_of_file, format="kitti"),
        positions=_gps_positions(oxts_files) if has_gps else None,
        times=_read_times(folder / "velodyne_points" / "timestamps.txt", paths),
        pose_source="oxts (GPS)" if has_gps else None,
        found=("format: KITTI raw",),
    )


def _drives(root: Path) -> tuple[Path, ...]:
    """Return the folders of the drives, in order of their names. `root` is a drive, a day, or a folder of days."""
    scan_folders = (path for pattern in ("", "*/", "*/*/") for path in root.glob(f"{pattern}velodyne_points"))
    return tuple(sorted((path.parent.resolve() for path in scan_folders), key=lambda drive: drive.name))


def _gps_positions(files: list[Path]) -> Float[np.ndarray, "n 3"]:
    """Return positions by the first row of each file, relative to the first position: metres east, north and up."""
    rows = [read_rows(file, columns=OXTS_COLUMNS)[:1] for file in files]
    latitude, longitude, altitude = np.concatenate(rows)[:, :3].T
    invalid = np.flatnonzero(np.abs(latitude) >= POLE_DEG)
    if invalid.size:
        found = f"found {latitude[invalid[0]]}"
        raise ValueError(f"{files[invalid[0]]}: expected a latitude below {POLE_DEG:g} degrees, {found}")
    scale = math.cos(math.radians(latitude[0]))  # Mercator projection, true to scale at the first position
    east = scale * EARTH_M * np.radians(longitude)
    north = scale * EARTH_M * np.log(np.tan(np.radians(90 + latitude) / 2))
    positions = np.stack([east, north, altitude], axis=1)
    return positions - positions[0]


def _read_times(file: Path, paths: tuple[Path, ...]) -> Float[np.ndarray, " n"] | None:
    """Return the times of the scans in seconds since 1970, or None if `timestamps.txt` does not exist."""
    if not file.is_file():
        return None
    lines = file.read_text(errors="replace").splitlines()  # with blank lines: scan i is line i
    try:
        stamps = np.array([lines[int(path.stem)].strip().replace(" ", "T") for path in paths], "datetime64[ns]")
        if np.isnat(stamps).any():  # numpy converts a blank line to NaT
            raise ValueError(f"the line of scan {paths[int(np.isnat(stamps).argmax())].stem} is blank")
    except (ValueError, IndexError) as error:
        raise ValueError(
            f"{file}: expected a date and time such as 2011-09-26 13:02:25.951199337 for each of {len(paths)} scans,"
            f" found {len(lines)} lines or malformed ones ({in_short(error)})"
        ) from error
    return stamps.astype(np.int64) / 1e9


READER = Reader("DATE/DRIVE/velodyne_points/data/*.bin (KITTI raw)", recording_names, open_recording, rank=6)
