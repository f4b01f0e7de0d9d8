"""Reader of NCLT: sessions of one place on many days. The ground truth of all sessions has one common frame.

- `2012-01-15/velodyne_sync/1326652795280148.bin`: a scan, named by its time in microseconds since 1970.
- `groundtruth_2012-01-15.csv`: utime, x, y, z, roll, pitch, yaw. It may also lie in the date's folder or in
  `ground_truth/`.

The ground truth is world_from_body, in metres. The world frame is north, east, down, with one origin for all sessions.
The body frame is forward, right, down, with its origin on the ground. The scans of `velodyne_sync` are already in the
body frame, so no extrinsics are used. (The Velodyne itself is mounted upside down, 1.0 m above that origin.)

The reader negates y and z of both frames, a rotation by 180 degrees about x. The positions are those of the body, x
north, y west, z up. The points are x forward, y left, z up.
"""

from functools import partial
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int64

from sglpr_jax.data.formats.bin_records import Z_UP_FROM_Z_DOWN, read_records
from sglpr_jax.data.formats.pose_files import read_stamped_rows
from sglpr_jax.data.mounting import Mounting
from sglpr_jax.data.readers.listing import names_of
from sglpr_jax.data.readers.reader import Reader, ReadOptions
from sglpr_jax.data.readers.stamped import stamped_recording
from sglpr_jax.data.recording import Recording
from sglpr_jax.data.times import check_order

MAX_GAP_S = 0.5
"""Maximum time between a scan and its pose, in seconds. A Segway moves half a metre in this time."""

BODY = Mounting(0.0)
"""Mounting of the body frame: the origin of the points is on the ground, not at the sensor."""
_DATE = "[0-9][0-9][0-9][0-9]-[0-9][0-9]-[0-9][0-9]"


def open_recording(root: Path, name: str, options: ReadOptions) -> Recording:
    """Open the session `root/<name>`."""
    file = f"groundtruth_{name}.csv"
    places = (root / file, root / name / file, root / "ground_truth" / file)
    truth = next((path for path in places if path.is_file()), None)
    if truth is None:
        raise FileNotFoundError(f"{root}: expected {' or '.join(str(p.relative_to(root)) for p in places)}, found none")
    stamps, positions = read_ground_truth(truth)
    return stamped_recording(
        root / name / "velodyne_sync",
        name,
        stamps=stamps,
        positions=positions,
        pose_file=truth,
        tick_s=1e-6,
        read_points=partial(read_records, format="nclt"),
        max_gap_s=MAX_GAP_S,
        mounting=BODY,
        found=("sensor: coordinates are relative to the ground below it",),
    )


def read_ground_truth(path: Path) -> tuple[Int64[np.ndarray, " n"], Float[np.ndarray, "n 3"]]:
    """Read times in microseconds and positions in metres (north, west, up). Rows with NaN are dropped."""
    stamps, numbers = read_stamped_rows(path, columns=7, finite=False)
    known = np.isfinite(numbers).all(axis=1)
    if not known.any():
        raise ValueError(f"{path}: expected poses, found NaN in all {len(numbers)} rows")
    check_order(stamps[known] * 1e-6, source=path)
    return stamps[known], numbers[known, :3] * Z_UP_FROM_Z_DOWN


READER = Reader(
    "YYYY-MM-DD/velodyne_sync/*.bin (NCLT)",
    partial(names_of, pattern=f"{_DATE}/velodyne_sync/"),
    open_recording,
    rank=2,
)
