"""Reader of MulRan: an Ouster OS1-64 on a car.

- `KAIST01/Ouster/1561000444390857630.bin`: float32 x, y, z, intensity. The name is the time in nanoseconds.
- `KAIST01/global_pose.csv`: time and 12 numbers (world_from_base, in axes east, north, up), about 100 rows per second.

The Ouster is rotated by 180 degrees about z relative to the car (179.67 degrees by its calibration). The points are
rotated so that x points forward. Positions are those of the Ouster.
"""

from pathlib import Path

import numpy as np

from sglpr_jax.data.formats.bin_records import described, read_records
from sglpr_jax.data.formats.clouds import Records
from sglpr_jax.data.reader import Reader
from sglpr_jax.data.readers.stamped import read_table, stamped_recording
from sglpr_jax.data.recording import Recording

LIDAR_IN_BASE_M = np.array([1.7042, -0.021, 1.8047])
"""Position of the Ouster in the car's frame by the dataset's calibration, in metres."""
FORWARD_FROM_LIDAR = np.array([-1, -1, 1], np.float32)
POSES = "global_pose.csv"


def recording_names(root: Path) -> tuple[str, ...]:
    """Return the names of the sequences in `root`. `root` may be a sequence itself."""
    if _is_sequence(root):
        return (root.resolve().name,)
    return tuple(sorted(path.parent.name for path in root.glob("*/Ouster") if _is_sequence(path.parent)))


def open_recording(root: Path, name: str) -> Recording:
    """Open a sequence. Raises what `stamped_recording` and `read_table` raise."""
    folder = root if _is_sequence(root) else root / name
    stamps, numbers = read_table(folder / POSES, columns=13)
    world_from_base = numbers.reshape(-1, 3, 4)
    return stamped_recording(
        folder / "Ouster",
        name,
        stamps=stamps,
        positions=world_from_base[:, :, :3] @ LIDAR_IN_BASE_M + world_from_base[:, :, 3],
        pose_file=folder / POSES,
        tick_s=1e-9,
        read_points=read_points,
        format=f"MulRan, {described('kitti')}, rotated to x forward",
    )


def read_points(path: Path) -> Records:
    """Read a scan and rotate its points so that x points forward."""
    return Records(read_records(path, "kitti").points * FORWARD_FROM_LIDAR, None)


def _is_sequence(folder: Path) -> bool:
    return (folder / "Ouster").is_dir() and (folder / POSES).is_file()


READER = Reader(
    layout="NAME/Ouster/*.bin with NAME/global_pose.csv (MulRan)",
    recording_names=recording_names,
    open=lambda root, name, options: open_recording(root, name),
    knows_mounting=False,
    rank=3,
)
