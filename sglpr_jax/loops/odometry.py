"""Odometry from files: a pose of the LiDAR for each scan, position and rotation, in a frame that stays."""

from pathlib import Path

import numpy as np
from jaxtyping import Float

from sglpr_jax.loops.choices import OdometryFormat
from sglpr_jax.loops.graph_files import read_g2o, read_kitti, read_tum
from sglpr_jax.poses import are_rotations


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


def _format_of(path: Path) -> OdometryFormat:
    if not path.is_file():
        raise FileNotFoundError(f"{path}: expected odometry, found no file")
    if path.suffix == ".g2o":
        return "g2o"
    lines = (line.split() for line in path.read_text(errors="replace").splitlines() if not line.startswith("#"))
    columns = len(next(lines, []))
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
