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
from sglpr_jax.data.reader import Reader
from sglpr_jax.data.readers.stamped import read_table, stamped_recording
from sglpr_jax.data.recording import Recording

POSES = Path("applanix") / "lidar_poses.csv"
COLUMNS = 13


def recording_names(root: Path) -> tuple[str, ...]:
    """Return the names of the sequences in `root`. `root` may be a sequence itself."""
    if _is_sequence(root):
        return (root.resolve().name,)
    return tuple(sorted(path.parent.name for path in root.glob("*/lidar") if _is_sequence(path.parent)))


def open_recording(root: Path, name: str) -> Recording:
    """Open a sequence. Raises what `stamped_recording` and `read_table` raise."""
    folder = root if _is_sequence(root) else root / name
    stamps, numbers = read_table(folder / POSES, columns=COLUMNS, header_lines=1)
    return stamped_recording(
        folder / "lidar",
        name,
        stamps=stamps,
        positions=np.ascontiguousarray(numbers[:, :3]),
        pose_file=folder / POSES,
        tick_s=1e-6,
        read_points=partial(read_records, format="float32x6", last_is_time=True),
        format=f"Boreas, {described('float32x6')}",
    )


def _is_sequence(folder: Path) -> bool:
    return (folder / "lidar").is_dir() and (folder / POSES).is_file()


READER = Reader(
    layout="NAME/lidar/*.bin with NAME/applanix/lidar_poses.csv (Boreas)",
    recording_names=recording_names,
    open=lambda root, name, options: open_recording(root, name),
    knows_mounting=False,
    rank=5,
)
