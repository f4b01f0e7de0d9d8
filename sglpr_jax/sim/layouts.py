"""File layouts of simulated drives: scans as in KITTI or NCLT, or images with label images as in BEVPlace."""

import functools
import io
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Float32, Int, UInt
from PIL import Image
from scipy.spatial.transform import Rotation

from sglpr_jax.data.corruption import Corruption, corrupt, ring_numbers
from sglpr_jax.data.density_image import density_image, density_label_image
from sglpr_jax.data.formats.bin_records import NCLT_OFFSET_M, NCLT_RECORD, NCLT_UNIT_M, Z_UP_FROM_Z_DOWN
from sglpr_jax.data.formats.pose_files import CAMERA_FROM_LIDAR
from sglpr_jax.data.mounting import MODEL_HEIGHT_M, Mounting
from sglpr_jax.data.views import rotated
from sglpr_jax.sim.drive import TimedPoses

THINNED, FEWER_BEAMS = 0.4, 0.3
"""Fraction of the scans that lose random points, and fraction that loses whole rings. Other scans keep all points."""
MOST_LOST = 0.95  # maximum of the uniformly distributed fraction of lost points
BEAMS = (32.0, 16.0)  # possible numbers of remaining beams


class Layout(NamedTuple):
    """Folder, file names and file contents of a drive."""

    folder: str  # folder of drive `{name}`, relative to the dataset's folder
    scan_files: tuple[str, ...]  # files of scan `{id}`, relative to the drive's folder
    scan_contents: Callable[[np.ndarray, np.ndarray, Mounting | None], tuple[bytes, ...]]
    """Function that returns the contents of these files from points (n, 4), labels (n,) and the sensor's mounting.

    A mounting of None is the mounting that the models expect.
    """
    drive_contents: Callable[[TimedPoses, Mounting | None], dict[str, bytes]]
    """Function that returns the contents of the files of the whole drive, by name. They are written after all scans."""
    last_file: str  # last of the files of the whole drive; if it exists, the drive is complete

    def files_of_scan(self, root: Path, name: str, id: str) -> tuple[Path, ...]:
        """Paths of the files of scan `id` in drive `name`."""
        return tuple(root / self.folder.format(name=name) / file.format(id=id) for file in self.scan_files)

    def file_of_drive(self, root: Path, name: str, file: str) -> Path:
        """Path of a file of the whole drive `name`."""
        return root / self.folder.format(name=name) / file.format(name=name)

    def is_finished(self, root: Path, name: str) -> bool:
        """Whether drive `name` is complete."""
        return self.file_of_drive(root, name, self.last_file).exists()


def _image_and_labels(
    points: Float[np.ndarray, "n 4"], labels: np.ndarray, mounting: Mounting | None, *, varied: bool = False
) -> tuple[bytes, ...]:
    """PNG of a levelled scan's density image, and PNG of the raw label ids of its pixels, 0 for empty pixels.

    With `varied`, the scan is changed by `vary` first.
    """
    xyz = points[:, :3].astype(np.float32)
    if varied:
        xyz, labels = vary(xyz, labels, mounting)
    elif mounting is not None:
        xyz = mounting.level(xyz)
    image = density_image(xyz)
    label_image = np.where(image > 0, density_label_image(xyz, labels), 0)
    return _encode_png(image), _encode_png(label_image.astype(np.uint16))


def _encode_png(pixels: UInt[np.ndarray, "rows columns"]) -> bytes:
    png = io.BytesIO()
    Image.fromarray(pixels).save(png, format="png")
    return png.getvalue()


def _matrix_line(matrix: Float[np.ndarray, "r 4"]) -> str:
    """Line of the 12 numbers in the first three rows of a matrix."""
    return " ".join(f"{value:.9g}" for value in matrix[:3].ravel()) + "\n"


def _kitti_files(poses: TimedPoses, _mounting: Mounting | None) -> dict[str, bytes]:
    """Calibration with identity projections, times, and poses world_from_camera, both in a camera's axes."""
    projections = "".join(f"P{i}: {_matrix_line(np.eye(4))}" for i in range(4))
    world_from_camera = CAMERA_FROM_LIDAR @ poses.world_from_lidar @ CAMERA_FROM_LIDAR.T
    return {
        "calib.txt": f"{projections}Tr: {_matrix_line(CAMERA_FROM_LIDAR)}".encode(),
        "times.txt": "".join(f"{time:.6e}\n" for time in poses.times).encode(),
        "poses.txt": "".join(_matrix_line(pose) for pose in world_from_camera).encode(),
    }


def _height_m(mounting: Mounting | None) -> float:
    return MODEL_HEIGHT_M if mounting is None else mounting.height_m


def _nclt_scan(points: Float[np.ndarray, "n 4"], _labels: np.ndarray, mounting: Mounting | None) -> tuple[bytes, ...]:
    """Bytes of a scan in NCLT's body frame: x forward, y right, z down, origin on the ground."""
    above_ground = np.add(points[:, :3].astype(np.float64), [0, 0, _height_m(mounting)])
    body = above_ground * Z_UP_FROM_Z_DOWN
    records = np.zeros(len(points), NCLT_RECORD)
    records["xyz"] = np.round((body - NCLT_OFFSET_M) / NCLT_UNIT_M)
    records["intensity"] = np.round(255 * points[:, 3])
    return (records.tobytes(),)


def _nclt_files(poses: TimedPoses, mounting: Mounting | None) -> dict[str, bytes]:
    """Ground truth in the axes north, east, down, with one row per scan."""
    lidar_from_body = np.eye(4)
    lidar_from_body[2, 3] = -_height_m(mounting)
    world_from_body = poses.world_from_lidar @ lidar_from_body
    rotations = np.diag(Z_UP_FROM_Z_DOWN) @ world_from_body[:, :3, :3] @ np.diag(Z_UP_FROM_Z_DOWN)
    roll_pitch_yaw = Rotation.from_matrix(rotations).as_euler("ZYX")[:, ::-1]
    positions = world_from_body[:, :3, 3] * Z_UP_FROM_Z_DOWN
    rows = zip(poses.times, np.concatenate([positions, roll_pitch_yaw], axis=1), strict=True)
    lines = (f"{to_utime(time)}," + ",".join(f"{value:.9g}" for value in row) for time, row in rows)
    return {"groundtruth_{name}.csv": "".join(f"{line}\n" for line in lines).encode()}


def to_utime(seconds: float) -> int:
    """Converts seconds since 1970 to whole microseconds, which are the names of NCLT's scans."""
    return round(seconds * 1e6)


_IMAGES = Layout(
    folder="{name}",
    scan_files=("imgs/{id}.png", "labels/{id}.png"),
    scan_contents=_image_and_labels,
    drive_contents=lambda poses, _: {"pose.txt": "".join(map(_matrix_line, poses.world_from_lidar)).encode()},
    last_file="pose.txt",
)
LAYOUTS = {
    "scans": Layout(
        folder="sequences/{name}",
        scan_files=("velodyne/{id}.bin", "labels/{id}.label"),
        scan_contents=lambda points, labels, _: (points.astype("<f4").tobytes(), labels.astype("<u4").tobytes()),
        drive_contents=_kitti_files,
        last_file="poses.txt",
    ),
    "images": _IMAGES,
    "varied": _IMAGES._replace(scan_contents=functools.partial(_image_and_labels, varied=True)),
    "nclt": Layout(
        folder="{name}",
        scan_files=("velodyne_sync/{id}.bin",),
        scan_contents=_nclt_scan,
        drive_contents=_nclt_files,
        last_file="groundtruth_{name}.csv",
    ),
}
"""Layouts by name.

"scans" is the layout of KITTI odometry and SemanticKITTI. "images" and "varied" hold BEVPlace's density images with
label images, without times. "nclt" is the layout of NCLT's sessions, without labels.
"""


def vary(
    points: Float32[np.ndarray, "n 3"], labels: Int[np.ndarray, " n"], mounting: Mounting | None
) -> tuple[Float32[np.ndarray, "m 3"], Int[np.ndarray, " m"]]:
    """Removes random points or whole rings of most scans, levels the scan, and rotates it about z by a random angle.

    The random seed is a hash of `points`, which are in the LiDAR frame.
    """
    seed = zlib.crc32(points.tobytes())
    rng = np.random.default_rng(seed)
    kind, strength = rng.random(), rng.random()
    if kind < THINNED:
        corruption = Corruption("dropout", MOST_LOST * strength)
    elif kind < THINNED + FEWER_BEAMS and _has_rings(points):
        corruption = Corruption("beams", BEAMS[int(len(BEAMS) * strength)])
    else:
        corruption = Corruption("clean")
    remaining_rows = corrupt(points, corruption, rng=rng)[1]
    points, labels = points[remaining_rows], labels[remaining_rows]
    points = points if mounting is None else mounting.level(points)
    return rotated(points, 2 * np.pi * seed / 2**32), labels


def _has_rings(points: Float32[np.ndarray, "n 3"]) -> bool:
    """Whether the points are ordered in rings, unlike the points of submaps and of scattered patterns."""
    try:
        ring_numbers(points)
    except ValueError:
        return False
    return True
