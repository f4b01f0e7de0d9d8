"""How a simulated drive lies on disk: scans in KITTI's layout, or images in BEVPlace's."""

import io
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from PIL import Image

from sglpr_jax.data.density_image import density_image
from sglpr_jax.sim.drive import Drive

CAMERA_FROM_LIDAR = np.array([[0.0, -1, 0, 0], [0, 0, -1, 0], [1, 0, 0, 0], [0, 0, 0, 1]])
"""Camera x right, y down, z forward from LiDAR x forward, y left, z up; both at one place."""


class Layout(NamedTuple):
    """The files of a drive, all named relative to the dataset's folder."""

    folder: str
    """Of the drive `{name}`."""
    scan_files: tuple[str, ...]
    """Of scan `{i}`."""
    scan_contents: Callable[[np.ndarray, np.ndarray], tuple[bytes, ...]]
    """What is in them, from points (n, 4) and labels (n,)."""
    drive_contents: Callable[[Drive], dict[str, bytes]]
    """The files of the drive as a whole, written when all its scans are there."""
    last_file: str
    """Of these; says that the drive is finished."""

    def files_of_scan(self, root: Path, name: str, i: int) -> tuple[Path, ...]:
        """Where scan `i` of drive `name` lies."""
        return tuple(root / self.folder.format(name=name) / file.format(i=i) for file in self.scan_files)

    def is_finished(self, root: Path, name: str) -> bool:
        """Whether drive `name` was written to its end."""
        return (root / self.folder.format(name=name) / self.last_file).exists()


def _points_and_labels(points: Float[np.ndarray, "n 4"], labels: np.ndarray) -> tuple[bytes, ...]:
    return points.astype("<f4").tobytes(), labels.astype("<u4").tobytes()


def _image(points: Float[np.ndarray, "n 4"], _labels: np.ndarray) -> tuple[bytes, ...]:
    png = io.BytesIO()
    Image.fromarray(density_image(points[:, :3].astype(np.float32))).save(png, format="png")
    return (png.getvalue(),)


def _row(matrix: Float[np.ndarray, "r 4"]) -> str:
    return " ".join(f"{value:.9g}" for value in matrix[:3].ravel()) + "\n"


def _kitti_files(drive: Drive) -> dict[str, bytes]:
    """Calibration, times and poses; nothing here has a camera, so its projections are identities.

    A line of poses.txt is world_from_camera, in a world whose axes are a camera's as well.
    """
    projections = "".join(f"P{i}: {_row(np.eye(4))}" for i in range(4))
    poses = CAMERA_FROM_LIDAR @ drive.world_from_lidar @ CAMERA_FROM_LIDAR.T
    return {
        "calib.txt": f"{projections}Tr: {_row(CAMERA_FROM_LIDAR)}".encode(),
        "times.txt": "".join(f"{time:.6e}\n" for time in drive.times).encode(),
        "poses.txt": "".join(_row(pose) for pose in poses).encode(),
    }


def _bevplace_files(drive: Drive) -> dict[str, bytes]:
    return {"pose.txt": "".join(_row(pose) for pose in drive.world_from_lidar).encode()}


LAYOUTS = {
    "scans": Layout(
        folder="sequences/{name}",
        scan_files=("velodyne/{i:06d}.bin", "labels/{i:06d}.label"),
        scan_contents=_points_and_labels,
        drive_contents=_kitti_files,
        last_file="poses.txt",
    ),
    "images": Layout(
        folder="{name}",
        scan_files=("imgs/{i:06d}.png",),
        scan_contents=_image,
        drive_contents=_bevplace_files,
        last_file="pose.txt",
    ),
}
"""KITTI odometry's and SemanticKITTI's layout, and BEVPlace's density images, which have neither labels nor times."""
