"""Tiny datasets on disk, in the layouts that the readers know."""

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

KITTI_FRAMES = (0, 2, 3)
KITTI_POINTS = 5


def write_rows(path: Path, rows: np.ndarray) -> None:
    """Write one line of numbers per row."""
    path.parent.mkdir(parents=True, exist_ok=True)
    np.savetxt(path, np.atleast_2d(rows))


def poses_at(positions: np.ndarray) -> np.ndarray:
    """Return unrotated poses as rows of 12 numbers."""
    rows = np.tile(np.eye(3, 4), (len(positions), 1, 1))
    rows[:, :, 3] = positions
    return rows.reshape(-1, 12)


@pytest.fixture
def kitti_root(tmp_path: Path) -> Path:
    """KITTI's layout: sequence 08 with frames 0, 2 and 3 of four, labels for 0 and 3, 10 m from frame to frame."""
    root = tmp_path / "kitti"
    folder = root / "sequences" / "08"
    for part in ("velodyne", "labels"):
        (folder / part).mkdir(parents=True)
    for frame in KITTI_FRAMES:
        points = np.arange(KITTI_POINTS * 4, dtype="<f4").reshape(-1, 4) + 50 * frame
        points.tofile(folder / "velodyne" / f"{frame:06d}.bin")
        if frame != 2:
            (np.arange(KITTI_POINTS, dtype="<u4") + 48 + (7 << 16)).tofile(folder / "labels" / f"{frame:06d}.label")
    camera = np.array([[1.0, 2.0, 10.0 * frame] for frame in range(4)])
    write_rows(folder / "poses.txt", poses_at(camera))
    write_rows(root / "poses" / "08.txt", poses_at(camera + np.array([0, 50, 0])))
    write_rows(folder / "times.txt", np.arange(4)[:, None] / 10)
    return root


@pytest.fixture
def bev_root(tmp_path: Path) -> Path:
    """BEVPlace's layout: sequence 06 with three 5 x 7 images."""
    root = tmp_path / "bev"
    (root / "06" / "imgs").mkdir(parents=True)
    for frame in range(3):
        Image.fromarray(np.arange(35, dtype=np.uint8).reshape(5, 7) * 7 + frame).save(
            root / "06" / "imgs" / f"{frame:06d}.png"
        )
    write_rows(root / "06" / "pose.txt", poses_at(np.arange(9.0).reshape(3, 3)))
    return root
