"""Odometry from files: a pose of the LiDAR for each scan, in a fixed frame."""

import dataclasses
from pathlib import Path

import numpy as np
from jaxtyping import Float

from sglpr_jax.data.choices import TimeUnit
from sglpr_jax.data.formats.pose_files import FORMATS, detect_pose_format
from sglpr_jax.data.poses import poses_at_scans
from sglpr_jax.data.readers.ros import ENDINGS
from sglpr_jax.data.recording import Recording
from sglpr_jax.data.scan_stream import only
from sglpr_jax.fields import check_value
from sglpr_jax.odometry.config import OdometryFormat
from sglpr_jax.pose_graph.files import read_g2o


def read_odometry(
    path: Path | str, *, format: OdometryFormat = "auto", time_unit: TimeUnit = "auto"
) -> Float[np.ndarray, "n 4 4"]:
    """Read a file of poses, in order.

    Arguments:
      path: File with a pose of the LiDAR in each line, or a g2o graph.
      format: Format of the file. "auto" recognises g2o by its suffix and tum by 8 numbers a line. It does not guess the
        axes of files with 12 numbers a line.
      time_unit: Unit of the times of a tum file (`times_of`).

    Raises:
      FileNotFoundError: If the file does not exist.
      ValueError: If the file has another format or time unit, no poses or invalid poses.
    """
    return read_stamped(Path(path), format=format, time_unit=time_unit)[0]


def read_stamped(
    path: Path, *, format: OdometryFormat = "auto", time_unit: TimeUnit = "auto"
) -> tuple[Float[np.ndarray, "n 4 4"], Float[np.ndarray, " n"] | None]:
    """Read the poses of an odometry file, and their times in seconds, or None if its format is not tum. Arguments and
    errors are those of `read_odometry`."""
    check_value(format, OdometryFormat, f"{path}, format")
    check_value(time_unit, TimeUnit, f"{path}, time_unit")
    if path.suffix in ENDINGS:
        raise ValueError(f"{path}: expected a file of odometry, or the bag of the scans, found another bag")
    if not path.is_file():
        raise FileNotFoundError(f"{path}: expected odometry, found {'a folder' if path.is_dir() else 'no file'}")
    file_format = format
    if format == "auto":
        file_format = "g2o" if path.suffix == ".g2o" else detect_pose_format(path)
    if file_format == "csv":
        raise ValueError(f"{path}: expected odometry with rotations, as tum, found csv")
    if file_format != "g2o":
        poses, times = FORMATS[file_format][1](path, time_unit)
    else:
        times = None
        vertices = read_g2o(path).poses
        if sorted(vertices) != list(range(len(vertices))):
            raise ValueError(f"{path}: expected vertices 0, 1, 2, ... without gaps, found others")
        poses = np.array([vertices[i] for i in range(len(vertices))])
    if not len(poses):
        raise ValueError(f"{path}: expected at least one pose, found none")
    return poses, times


def match_to_scans(
    recording: Recording, odometry: Float[np.ndarray, "n 4 4"], stamps: Float[np.ndarray, " n"] | None, path: Path
) -> tuple[Recording, Float[np.ndarray, "q 4 4"]]:
    """Return the odometry at the scans of a recording: row by row or, if its times differ, interpolated.

    Scans without a pose are removed from the recording, which `Recording.found` reports. The other scans keep their
    numbers (`Recording.numbers`). If the scans have no times, the recording gets those of the poses.

    Arguments:
      recording: The scans.
      odometry: Poses that `read_stamped` read from `path`.
      stamps: Times of the poses in seconds, or None.
      path: File of the odometry, for messages.

    Returns:
      The recording, and a pose for each of its scans.

    Raises ValueError if most scans have no pose, or if the numbers of poses and scans differ and times are missing.
    """
    matched = poses_at_scans(
        str(path), odometry, stamps, recording.times, scans=len(recording), item=f"scan of {recording.name}"
    )
    if recording.times is None and stamps is not None:
        message = f"times: from {path.name}"
        return dataclasses.replace(recording, times=stamps, found=(*recording.found, message)), matched.poses
    if not matched.note:
        return recording, matched.poses
    recording = only(recording, np.flatnonzero(matched.has_pose).tolist())
    message = f"odometry: {len(odometry)} poses of {path.name}, {matched.note}"
    return dataclasses.replace(recording, found=(*recording.found, message)), matched.poses


def is_bag_of_recording(path: Path, root: Path) -> bool:
    """Whether `path` is the bag of the recording at `root`, so that the bag's poses are the odometry."""
    path, root = path.resolve(), root.resolve()
    return path.exists() and (path == root or (path.suffix in ENDINGS and path.parent == root))


def take_bag_odometry(recording: Recording, root: Path) -> tuple[Recording, Float[np.ndarray, "n 4 4"]]:
    """Return the recording of a bag without its poses, and these poses (n, 4, 4) as odometry.

    The recording loses them, because loops found with these poses must not be evaluated by them. Raises ValueError if
    the bag has no poses, or poses without rotations.
    """
    if recording.world_from_lidar is None:
        raise ValueError(
            f"{root}: expected a bag with poses (Odometry, PoseStamped or tf) with rotations, "
            f"found {recording.pose_source or 'no poses'}"
        )
    return dataclasses.replace(recording, positions=None, pose_source=None), recording.world_from_lidar
