"""Types of the options for reading files. They are in a separate module, so that command-line help imports no
readers."""

from typing import Literal

_Float32 = Literal["float32x3", "float32x4", "float32x5", "float32x6", "float32x7", "float32x8"]
_Float64 = Literal["float64x3", "float64x4", "float64x5", "float64x6"]
RecordFormat = Literal["kitti", "nuscenes", "nclt", _Float32, _Float64]
"""Format of a point in a .bin file. `kitti` is `float32x4`. `nuscenes` is `float32x5` with other axes and the laser
number in the last column."""
ScanFormat = Literal["auto", "pcd", "pcd-viewpoint", "ply", "npy", "npz", "las", RecordFormat]
"""Format of a scan file. "auto" takes the format from the file name, or from the content of .bin files.
"pcd-viewpoint" is pcd with its VIEWPOINT applied."""
PoseFormat = Literal["auto", "kitti", "lidar", "tum", "csv"]
PoseChoice = Literal["auto", "semantickitti", "kitti"]
"""Pose file to read from KITTI's layout, which may contain two."""
SensorHeight = float | Literal["auto", "estimate"]
"""Height of the sensor above the ground, in metres. "estimate" estimates the height and the tilt from the scans. "auto"
estimates them only if the layout does not define the sensor mounting."""
Gravity = Literal["auto", "recording", "scan"]
"""Mounting of the sensor: one for the recording, or height and tilt of each scan. "auto" estimates each scan if the
layout does not define the mounting and the sensor tilts, as a handheld one does."""
TimeUnit = Literal["auto", "s", "ms", "us", "ns"]
"""Unit of times in text files and from Python. "auto" expects seconds and rejects times whose steps contradict this. It
ignores row numbers (0, 1, 2, ...)."""
Scale = Literal[1, 2, 4]
"""Factor for all lengths of a recording before images are computed. Rooms fill an image only with a factor above 1."""
SCALE = "scale"
"""Name of the read option that states the scale of a recording."""
ScaleChoice = Literal["auto", 1, 2, 4]
"""Scale, or "auto", which chooses it from the ranges of the scans."""
