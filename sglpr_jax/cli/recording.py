"""The flags that open a recording, the same for every command that works on one."""

import dataclasses
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

from sglpr_jax.data.choices import PoseChoice, PoseFormat, ScanFormat, SensorHeight

if TYPE_CHECKING:
    import numpy as np
    from jaxtyping import Float

    from sglpr_jax.data import Recording
    from sglpr_jax.loops.choices import OdometryFormat


@dataclasses.dataclass(frozen=True)
class RecordingOptions:
    """Which recording of a folder, and how it is read."""

    seq: str | None = None
    """Which sequence, or session of NCLT (2012-01-15); may be left out where there is only one."""
    pose_source: PoseChoice = "auto"
    """Which poses of KITTI's layout: SemanticKITTI's (sequences/NN/poses.txt) or KITTI's own (poses/NN.txt)."""
    format: ScanFormat = "auto"
    """What each point of a .bin is, where neither its name nor a look into the files tells."""
    sensor_height: SensorHeight = "auto"
    """How many metres the sensor is above the ground; `estimate` finds it, and the tilt, from the scans, and `auto`
    does where the layout (a plain folder, a bag) does not tell."""
    pose_topic: str | None = None
    """The topic of a bag's poses, where it has several: /odom."""

    def open(self, root: Path) -> "Recording":
        """Open the recording, and say what was found. Raises what `data.open_recording` does."""
        from sglpr_jax.cli.datasets import open_recording  # this brings JAX and more, which --help does not need

        options: dict[str, Any] = {name: value for name, value in vars(self).items() if name != "seq"}
        return open_recording(root, self.seq, **options)


@dataclasses.dataclass(frozen=True)
class PosedRecordingOptions(RecordingOptions):
    """Which recording of a folder, how it is read, and where a plain folder of scans was taken."""

    poses: Path | None = None
    """The pose file of a plain folder, where none lies beside the scans: a row for each scan, or poses of other times,
    which are interpolated where the scans have times too."""
    pose_format: PoseFormat = "auto"
    """kitti: camera frame (KITTI, SemanticKITTI); lidar: 12 numbers, z up; tum; csv with a header (x, y, z, t)."""
    times: Path | None = None
    """Seconds, one number a line, where no times.txt lies beside the scans."""


def open_with_poses(
    source: RecordingOptions, root: Path, path: Path, *, format: "OdometryFormat"
) -> "tuple[Recording, Float[np.ndarray, 'n 4 4']]":
    """Open a recording, with a pose for each scan from the file at `path` or, where that is the bag itself, from it.

    Poses of other times than the scans' are interpolated; scans without one are left out, which is said.
    """
    from sglpr_jax.loops.odometry import at_scans, is_own, own_odometry, read_odometry

    if is_own(path, root):
        return own_odometry(source.open(root), root)
    odometry = read_odometry(path, format=format)  # first, since a bag takes its time to open
    opened = source.open(root)
    recording, poses = at_scans(opened, odometry, path, format=format)
    if recording is not opened:
        print(recording.found[-1], file=sys.stderr)
    return recording, poses


def report_bad_scan(scan: str, error: Exception) -> None:
    """Say on stderr that a scan is left out, and why."""
    print(f"skipped {scan}: {error}", file=sys.stderr)
