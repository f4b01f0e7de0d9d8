"""Reader of MulRan: an Ouster OS1-64 on a car.

- `KAIST01/Ouster/1561000444390857630.bin`: float32 x, y, z, intensity. The name is the time in nanoseconds.
- `KAIST01/global_pose.csv`: time and 12 numbers (world_from_base, in axes east, north, up), about 100 rows per second.

The Ouster is rotated by 180 degrees about z relative to the car (179.67 degrees by its calibration). The points are
rotated so that x points forward. Positions are those of the Ouster.
"""

from pathlib import Path

import numpy as np

from sglpr_jax.data.formats.bin_records import described, read_records
from sglpr_jax.data.readers.reader import Reader, ReadOptions
from sglpr_jax.data.readers.stamped import read_table, sequences, stamped_recording
from sglpr_jax.data.record import Record
from sglpr_jax.data.recording import Recording

LIDAR_IN_BASE_M = np.array([1.7042, -0.021, 1.8047])
"""Position of the Ouster in the car's frame by the dataset's calibration, in metres."""
FORWARD_FROM_LIDAR = np.array([-1, -1, 1], np.float32)
POSES = "global_pose.csv"


def recording_names(root: Path) -> tuple[str, ...]:
    """Return the names of the sequences in `root`. `root` may be a sequence itself."""
    return tuple(sequences(root, "Ouster", POSES))


def open_recording(root: Path, name: str, options: ReadOptions) -> Recording:
    """Open a sequence. Raises what `stamped_recording` and `read_table` raise."""
    folder = sequences(root, "Ouster", POSES)[name]
    stamps, numbers = read_table(folder / POSES, columns=13)
    world_from_base = numbers.reshape(-1, 3, 4)
    return stamped_recording(
        folder / "Ouster",
        name,
        stamps=stamps,
        positions=world_from_base[:, :, :3] @ LIDAR_IN_BASE_M + world_from_base[:, :, 3],
        pose_file=folder / POSES,
        tick_s=1e-9,
        read_points=lambda path: Record(points=read_records(path, "kitti").cloud * FORWARD_FROM_LIDAR),
        found=(f"format: MulRan, {described('kitti')}, rotated to x forward",),
    )


READER = Reader(
    "NAME/Ouster/*.bin with NAME/global_pose.csv (MulRan)",
    recording_names,
    open_recording,
    knows_mounting=False,
    rank=3,
)
