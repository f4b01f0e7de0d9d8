"""Reader of Boreas: a Velodyne Alpha Prime on a car, recorded over a year.

- `boreas-2020-12-01-13-26/lidar/1606847163437292.bin`: float32 x, y, z, intensity, laser, time.
- `boreas-2020-12-01-13-26/applanix/lidar_poses.csv`: GPSTime, easting, northing, altitude and nine other columns.

Scans are named by their time. Names and GPSTime are in microseconds. Positions are those of the LiDAR. The axes of the
points are not changed.
"""

from functools import partial
from pathlib import Path

import numpy as np

from sglpr_jax.data.formats.bin_records import described, read_records
from sglpr_jax.data.readers.reader import Reader, ReadOptions
from sglpr_jax.data.readers.stamped import read_table, sequences, stamped_recording
from sglpr_jax.data.recording import Recording

POSES = Path("applanix") / "lidar_poses.csv"
COLUMNS = 13


def recording_names(root: Path) -> tuple[str, ...]:
    """Return the names of the sequences in `root`. `root` may be a sequence itself."""
    return tuple(sequences(root, "lidar", POSES))


def open_recording(root: Path, name: str, options: ReadOptions) -> Recording:
    """Open a sequence. Raises what `stamped_recording` and `read_table` raise."""
    folder = sequences(root, "lidar", POSES)[name]
    stamps, numbers = read_table(folder / POSES, columns=COLUMNS, header_lines=1)
    return stamped_recording(
        folder / "lidar",
        name,
        stamps=stamps,
        positions=np.ascontiguousarray(numbers[:, :3]),
        pose_file=folder / POSES,
        tick_s=1e-6,
        read_points=partial(read_records, format="float32x6", last_is_time=True),
        found=(f"format: Boreas, {described('float32x6')}",),
    )


READER = Reader(
    "NAME/lidar/*.bin with NAME/applanix/lidar_poses.csv (Boreas)",
    recording_names,
    open_recording,
    knows_mounting=False,
    rank=5,
)
