"""Odometry from files: a pose of the LiDAR for each scan, position and rotation, in a frame that stays."""

import dataclasses
from pathlib import Path

import numpy as np
from jaxtyping import Float

from sglpr_jax.data.formats.pose_files import columns_of
from sglpr_jax.data.formats.timed_poses import interpolate, interpolate_turns, poses_of
from sglpr_jax.data.readable import only
from sglpr_jax.data.recording import Recording
from sglpr_jax.loops.choices import OdometryFormat
from sglpr_jax.loops.graph_files import read_g2o, read_kitti, read_tum
from sglpr_jax.loops.transforms import quaternions
from sglpr_jax.poses import are_rotations

LEAST_SHARE = 0.5
"""Of the scans must have poses about their times, for a file to be their odometry."""
BAGS = (".bag", ".mcap", ".db3")


def read_odometry(path: Path | str, *, format: OdometryFormat = "auto") -> Float[np.ndarray, "n 4 4"]:
    """Read a pose for each scan, in order.

    "auto" knows g2o by its ending and tum by its 8 numbers a line; which axes 12 numbers have it does not guess. Raises
    FileNotFoundError, and ValueError naming the file, what was expected and what was found.
    """
    path = Path(path)
    format = _format_of(path) if format == "auto" else format
    poses = _READERS[format](path)
    if not len(poses):
        raise ValueError(f"{path}: expected at least one pose, found none")
    turned = poses[:, :3, :3]
    wrong = ~are_rotations(turned)
    if wrong.any():
        raise ValueError(f"{path}, pose {int(wrong.argmax())}: expected a rotation, found {turned[wrong][0].tolist()}")
    return poses


def at_scans(
    recording: Recording, odometry: Float[np.ndarray, "n 4 4"], path: Path, *, format: OdometryFormat
) -> tuple[Recording, Float[np.ndarray, "q 4 4"]]:
    """The recording, and a pose for each of its scans from what `read_odometry` found at `path`.

    Poses go with the scans row by row; where the scans have no times, they get those of a tum file. One of another
    length is interpolated at the times of the scans; those more than 1 s between two poses, or before the first and
    after the last, are left out, which is told. Raises ValueError where these are most, and where the length is another
    one and nothing tells the times.
    """
    tum = (_format_of(path) if format == "auto" else format) == "tum"
    if len(odometry) == len(recording):
        return (_timed(recording, path) if tum and recording.times is None else recording), odometry
    if recording.times is None or not tum:
        why = "the scans have no times" if tum else "the file has no times"
        raise ValueError(
            f"{path}: expected {len(recording)} poses, one for each scan of {recording.name}, found {len(odometry)}, "
            f"and {why} to interpolate at"
        )
    stamps, times = read_tum(path)[1], recording.times
    kept, positions = interpolate(stamps, odometry[:, :3, 3], times)
    if kept.mean() < LEAST_SHARE:
        raise ValueError(
            f"{path}: expected odometry of {len(recording)} poses, one for each scan of {recording.name}, or poses at "
            f"most 1 s apart about the times of these, {times[0]:.1f} to {times[-1]:.1f} s, found {len(odometry)} of "
            f"{stamps[0]:.1f} to {stamps[-1]:.1f} s"
        )
    turned = interpolate_turns(stamps, quaternions(odometry), times)
    missing = len(kept) - int(kept.sum())
    left_out = f"; {missing} of {len(kept)} scans left out, which have no pose" if missing else ""
    said = f"odometry: {len(odometry)} poses of {path.name}, interpolated at the times of the scans{left_out}"
    chosen = only(recording, np.flatnonzero(kept).tolist())
    return dataclasses.replace(chosen, found=(*chosen.found, said)), poses_of(positions, turned)[kept]


def _timed(recording: Recording, path: Path) -> Recording:
    """The recording with the times of a tum file that has a row for each scan."""
    times = read_tum(path)[1]
    return dataclasses.replace(recording, times=times, found=(*recording.found, f"times: those of {path.name}"))


def is_own(path: Path, root: Path) -> bool:
    """Whether a user who names `path` for odometry means the poses of the recording itself, a bag."""
    path, root = path.resolve(), root.resolve()
    return path.exists() and (path == root or (path.suffix in BAGS and path.parent == root))


def own_odometry(recording: Recording, root: Path) -> tuple[Recording, Float[np.ndarray, "n 4 4"]]:
    """The poses that a recording has by the messages of its bag, and the recording without: they judge nothing then.

    Raises ValueError where they tell no rotations.
    """
    if recording.world_from_lidar is None:
        raise ValueError(
            f"{root}: expected a bag with poses (Odometry, PoseStamped or tf) that tell rotations, "
            f"found {recording.pose_source or 'no poses'}"
        )
    return dataclasses.replace(recording, positions=None, pose_source=None), recording.world_from_lidar


def _format_of(path: Path) -> OdometryFormat:
    if path.suffix in BAGS:
        raise ValueError(f"{path}: expected odometry from a file, or the bag that has the scans, found another bag")
    if not path.is_file():
        raise FileNotFoundError(f"{path}: expected odometry, found no file")
    if path.suffix == ".g2o":
        return "g2o"
    columns = columns_of(path)
    if columns == 8:
        return "tum"
    found = "an empty file" if not columns else f"{columns} numbers a line"
    raise ValueError(
        f"{path}: expected odometry as tum (8 numbers a line) or g2o, or 12 numbers a line and their axes named, "
        f"kitti (camera axes) or lidar (z up), by --odometry-format (of bin/map: --pose-format), found {found}"
    )


def _vertices(path: Path) -> Float[np.ndarray, "n 4 4"]:
    poses = read_g2o(path).poses
    if sorted(poses) != list(range(len(poses))):
        raise ValueError(f"{path}: expected vertices 0, 1, 2, ... without a gap, found others")
    return np.array([poses[i] for i in range(len(poses))]).reshape(-1, 4, 4)


_READERS = {
    "kitti": read_kitti,
    "lidar": lambda path: read_kitti(path, camera=False),
    "tum": lambda path: read_tum(path)[0],
    "g2o": _vertices,
}
