"""Odometry from files: a pose of the LiDAR for each scan, in a fixed frame."""

import dataclasses
from pathlib import Path

import numpy as np
from jaxtyping import Float

from sglpr_jax.data.choices import TimeUnit
from sglpr_jax.data.formats.pose_files import columns_of, read_kitti, read_tum
from sglpr_jax.data.poses import poses_at_scans
from sglpr_jax.data.recording import Recording
from sglpr_jax.data.scan_stream import only
from sglpr_jax.fields import check_value
from sglpr_jax.odometry.config import OdometryFormat
from sglpr_jax.pose_graph.files import read_g2o

BAGS = (".bag", ".mcap", ".db3")


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
    path = Path(path)
    check_value(format, OdometryFormat, f"{path}, format")
    check_value(time_unit, TimeUnit, f"{path}, time_unit")
    format = _format_of(path) if format == "auto" else format
    if format == "tum":
        poses = read_tum(path, time_unit=time_unit)[0]
    elif format == "g2o":
        found = read_g2o(path).poses
        if sorted(found) != list(range(len(found))):
            raise ValueError(f"{path}: expected vertices 0, 1, 2, ... without gaps, found others")
        poses = np.array([found[i] for i in range(len(found))])
    else:
        poses = read_kitti(path, camera=format == "kitti")
    if not len(poses):
        raise ValueError(f"{path}: expected at least one pose, found none")
    return poses


def at_scans(
    recording: Recording,
    odometry: Float[np.ndarray, "n 4 4"],
    path: Path,
    *,
    format: OdometryFormat,
    time_unit: TimeUnit = "auto",
) -> tuple[Recording, Float[np.ndarray, "q 4 4"]]:
    """Match odometry to the scans of a recording.

    Poses are matched row by row. If a tum file has other times than the scans, poses are interpolated at the times of
    the scans (`poses_at_scans`). Scans without a pose are removed from the recording, and `Recording.found` says so.
    The other scans keep their numbers (`Recording.numbers`). If the scans have no times, they get the times of a tum
    file.

    Arguments:
      recording: The scans.
      odometry: Poses that `read_odometry` read from `path`.
      path: File of the odometry.
      format: Format of the file.
      time_unit: Unit of the times of a tum file (`times_of`).

    Returns:
      The recording, and a pose for each of its scans.

    Raises:
      ValueError: If most scans have no pose, or if the numbers of poses and scans differ and times are missing.
    """
    tum = (_format_of(path) if format == "auto" else format) == "tum"
    stamps = read_tum(path, time_unit=time_unit)[1] if tum else None
    found = poses_at_scans(
        str(path), odometry, stamps, recording.times, scans=len(recording), of=f"scan of {recording.name}"
    )
    if recording.times is None and stamps is not None:
        said = f"times: from {path.name}"
        return dataclasses.replace(recording, times=stamps, found=(*recording.found, said)), found.poses
    if not found.said:
        return recording, found.poses
    chosen = only(recording, np.flatnonzero(found.kept).tolist())
    said = f"odometry: {len(odometry)} poses of {path.name}, {found.said}"
    return dataclasses.replace(chosen, found=(*chosen.found, said)), found.poses


def is_own(path: Path, root: Path) -> bool:
    """Whether `path` is the bag of the recording at `root`, so that its own poses are the odometry."""
    path, root = path.resolve(), root.resolve()
    return path.exists() and (path == root or (path.suffix in BAGS and path.parent == root))


def own_odometry(recording: Recording, root: Path) -> tuple[Recording, Float[np.ndarray, "n 4 4"]]:
    """Poses from the messages of the recording's bag, and the recording without them.

    The poses are removed, because loops found with them cannot be evaluated with them.

    Raises:
      ValueError: If the bag has no poses or the poses have no rotations.
    """
    if recording.world_from_lidar is None:
        raise ValueError(
            f"{root}: expected a bag with poses (Odometry, PoseStamped or tf) with rotations, "
            f"found {recording.pose_source or 'no poses'}"
        )
    return dataclasses.replace(recording, positions=None, pose_source=None), recording.world_from_lidar


def _format_of(path: Path) -> OdometryFormat:
    if path.suffix in BAGS:
        raise ValueError(f"{path}: expected a file of odometry, or the bag of the scans, found another bag")
    if not path.is_file():
        raise FileNotFoundError(f"{path}: expected odometry, found {'a folder' if path.is_dir() else 'no file'}")
    if path.suffix == ".g2o":
        return "g2o"
    columns = columns_of(path)
    if columns == 8:
        return "tum"
    found = "an empty file" if not columns else f"{columns} numbers a line"
    raise ValueError(
        f"{path}: expected odometry as tum (8 numbers a line) or g2o, found {found}; for 12 numbers a line, "
        "name the axes with --odometry-format (bin/map: --pose-format): kitti (camera axes) or lidar (z up)"
    )
