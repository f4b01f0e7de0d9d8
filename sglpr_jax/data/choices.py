"""What a user may choose about files: here, because a command line names it in its help without reading any file."""

from typing import Literal

RecordFormat = Literal[
    "kitti",
    "nuscenes",
    "nclt",
    "float32x3",
    "float32x4",
    "float32x5",
    "float32x6",
    "float32x7",
    "float32x8",
    "float64x3",
    "float64x4",
    "float64x5",
    "float64x6",
]
"""kitti is float32x4; nuscenes is float32x5 with other axes and the laser in the last column."""
ScanFormat = Literal["auto", "pcd", "ply", "npy", "npz", "las", RecordFormat]
"""What a scan file is; "auto": what its name says."""
PoseFormat = Literal["auto", "kitti", "lidar", "tum", "csv"]
PoseChoice = Literal["auto", "semantickitti", "kitti"]
"""Which of the two pose files of KITTI's layout."""
SensorHeight = float | Literal["auto", "estimate"]
"""Metres over the ground; "estimate" finds them, and the tilt, from the scans; "auto" does where the layout does not
tell how the sensor was mounted."""
