"""Odometry from files: a pose of the LiDAR for each scan, position and rotation, in a frame that stays."""

import dataclasses
from pathlib import Path

import numpy as np
from jaxtyping import Float

from sglpr_jax.data.formats.pose_files import columns_of
from sglpr_jax.data.formats.scan_poses import poses_at_scans
from sglpr_jax.data.readable import only
from sglpr_jax.data.recording import Recording
from sglpr_jax.fields import check_value
from sglpr_jax.loops.choices import OdometryFormat
from sglpr_jax.loops.graph_files import read_g2o, read_kitti, read_tum
from sglpr_jax.poses import are_rotations

BAGS = (".bag", ".mcap", ".db3")


def read_odometry(path: Path | str, *, format: OdometryFormat = "auto") -> Float[np.ndarray, "n 4 4"]:
    """Read a pose for each scan, in order.

    "auto" knows g2o by its ending and tum by its 8 numbers a line; which axes 12 numbers have it does not guess. Raises
    FileNotFoundError, and ValueError naming the file, what was expected and what was found.
    """
    path = Path(path)
    check_value(format, OdometryFormat, f"{path}, format")
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

    Poses go with the scans row by row, or by the times of a tum file where these are others (`poses_at_scans`, whose
    errors these are); scans without a pose are left out, which is told. Scans without times get those of a tum file.
    """
    tum = (_format_of(path) if format == "auto" else format) == "tum"
    stamps = read_tum(path)[1] if tum else None
    found = poses_at_scans(
        str(path), odometry, stamps, recording.times, scans=len(recording), of=f"scan of {recording.name}"
    )
    if recording.times is None and stamps is not None:
        said = f"times: those of {path.name}"
        return dataclasses.replace(recording, times=stamps, found=(*recording.found, said)), found.poses
    if not found.said:
        return recording, found.poses
    chosen = only(recording, np.flatnonzero(found.kept).tolist())
    said = f"odometry: {len(odometry)} poses of {path.name}, {found.said}"
    return dataclasses.replace(chosen, found=(*chosen.found, said)), found.poses


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
        raise FileNotFoundError(f"{path}: expected odometry, found {'a folder' if path.is_dir() else 'no file'}")
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
