"""Sessions of NCLT: one place on many days, each session with its own ground truth in one common frame.

    2012-01-15/velodyne_sync/1326652795280148.bin   scans; the number is the time in microseconds since 1970
    groundtruth_2012-01-15.csv                      utime, x, y, z, roll, pitch, yaw; in the date's folder or in
                                                    ground_truth/ as well

Frames. The ground truth is world_from_body: the world is north, east, down about one origin for all sessions, metres;
the body is forward, right, down, with its origin on the ground. The scans of `velodyne_sync` are in the body's frame
already, so no extrinsics are used (the Velodyne itself is upside down, 1.0 m above that origin). Both frames have y and
z negated here, a half turn about x: positions are those of the body, x north, y west, z up, as points are x forward,
y left, z up.
"""

from pathlib import Path

import numpy as np
from jaxtyping import Float, Int64

from sglpr_jax.data.formats.bin_records import Z_UP_FROM_Z_DOWN
from sglpr_jax.data.formats.timed_poses import match_times
from sglpr_jax.data.listing import files_in
from sglpr_jax.data.mounting import Mounting
from sglpr_jax.data.reader import Reader
from sglpr_jax.data.record import scan_record
from sglpr_jax.data.recording import Recording

MAX_GAP_S = 0.5
"""A scan without a pose this near in time is left out. A Segway goes half a metre in it."""

LATEST_US = 1e17
"""Times beyond the year 5000 are none."""

BODY = Mounting(0.0)
"""Points are given in the body's frame, whose origin is on the ground, and not from the sensor."""
_DATE = "[0-9][0-9][0-9][0-9]-[0-9][0-9]-[0-9][0-9]"
_COLUMNS = ("utime", "x", "y", "z", "roll", "pitch", "yaw")


def recording_names(root: Path) -> tuple[str, ...]:
    """Return the dates of the sessions in `root` that have a folder `velodyne_sync`, in order."""
    return tuple(sorted(folder.parent.name for folder in root.glob(f"{_DATE}/velodyne_sync") if folder.is_dir()))


def open_recording(root: Path, name: str, *, max_gap_s: float = MAX_GAP_S) -> Recording:
    """Open the session `root/<name>`, a date such as "2012-01-15". Each scan has the pose nearest to it in time.

    Scans with no pose within `max_gap_s` seconds are left out; `pose_source` says how many. Raises FileNotFoundError
    without scans or ground truth, ValueError where the ground truth is malformed or near to no scan.
    """
    paths = _scan_paths(root / name / "velodyne_sync")
    truth = _truth_path(root, name)
    stamps, positions = read_ground_truth(truth)
    utimes = np.array([int(path.stem) for path in paths], dtype=np.int64)
    matched = match_times(stamps, utimes, tick_s=1e-6, max_gap_s=max_gap_s, poses=truth, scans=paths[0].parent)
    kept_paths = tuple(path for path, keep in zip(paths, matched.kept, strict=True) if keep)
    return Recording(
        name=name,
        ids=tuple(path.stem for path in kept_paths),
        positions=positions[matched.rows],
        times=utimes[matched.kept] / 1e6,
        pose_source=matched.described(truth.name, max_gap_s=max_gap_s),
        paths=kept_paths,
        read=scan_record,
        mounting=BODY,
        found=("sensor: points are given from the ground below it",),
    )


def read_ground_truth(path: Path) -> tuple[Int64[np.ndarray, " n"], Float[np.ndarray, "n 3"]]:
    """Return the times in microseconds, in order, and the positions (metres; north, west, up) of a ground truth file.

    Rows with NaN, with which the files begin, are dropped. Raises ValueError where the file is no such table, all rows
    are NaN, or a time is smaller than the one before.
    """
    rows = _read_table(path)
    known = np.isfinite(rows).all(axis=1)
    if not known.any():
        raise ValueError(f"{path}: expected poses, found NaN in all {len(rows)} rows")
    late = np.flatnonzero(known & (np.abs(rows[:, 0]) > LATEST_US))
    if late.size:
        raise ValueError(f"{path}: expected times in microseconds, found {rows[late[0], 0]:g} in row {late[0] + 1}")
    stamps = rows[known, 0].astype(np.int64)
    backwards = np.flatnonzero(np.diff(stamps) < 0)
    if backwards.size:
        first = int(backwards[0])
        raise ValueError(f"{path}: expected a time from {stamps[first]} on, found {stamps[first + 1]} in the next row")
    return stamps, rows[known, 1:4] * Z_UP_FROM_Z_DOWN


def _scan_paths(folder: Path) -> tuple[Path, ...]:
    paths = files_in(folder, ".bin")
    if not paths:
        found = "none" if folder.is_dir() else "no such folder"
        raise FileNotFoundError(f"{folder}: expected scans (*.bin), found {found}")
    strange = next((path.name for path in paths if not path.stem.isdecimal()), None)
    if strange:
        raise ValueError(f"{folder}: expected scans named by their time, 1326652795280148.bin, found {strange}")
    return paths


def _truth_path(root: Path, name: str) -> Path:
    file = f"groundtruth_{name}.csv"
    places = (root / file, root / name / file, root / "ground_truth" / file)
    found = next((path for path in places if path.is_file()), None)
    if found is None:
        raise FileNotFoundError(f"{root}: expected {' or '.join(str(p.relative_to(root)) for p in places)}, found none")
    return found


def _read_table(path: Path) -> Float[np.ndarray, "n 7"]:
    if not path.read_bytes().strip():
        raise ValueError(f"{path}: expected rows of {', '.join(_COLUMNS)}, found an empty file")
    try:
        rows = np.loadtxt(path, delimiter=",", ndmin=2)
    except ValueError as error:
        raise ValueError(f"{path}: expected rows of {', '.join(_COLUMNS)}, found others ({error})") from error
    if rows.shape[1] != len(_COLUMNS):
        raise ValueError(f"{path}: expected {len(_COLUMNS)} columns, {', '.join(_COLUMNS)}, found {rows.shape[1]}")
    return rows


READER = Reader(
    layout="YYYY-MM-DD/velodyne_sync/*.bin (NCLT)",
    recording_names=recording_names,
    open=lambda root, name, options: open_recording(root, name),
    rank=2,
)
