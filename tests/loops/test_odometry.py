"""Odometry of every format is the same poses; what is none is one clear error."""

import numpy as np
import pytest

from sglpr_jax.loops.graph_files import write_g2o, write_kitti, write_tum
from sglpr_jax.loops.odometry import read_odometry
from sglpr_jax.loops.transforms import transform


@pytest.fixture
def poses() -> np.ndarray:
    return np.stack([transform(x, 0.1 * x, 0.3 * x) for x in np.arange(5.0)])


def test_every_format_gives_the_same_poses(tmp_path, poses):
    write_kitti(tmp_path / "kitti.txt", poses)
    write_tum(tmp_path / "tum.txt", poses, np.arange(5.0))
    write_g2o(tmp_path / "graph.g2o", [], poses)
    np.savetxt(tmp_path / "lidar.txt", poses[:, :3].reshape(5, 12))
    for name, format in (("kitti", "kitti"), ("tum", "auto"), ("tum", "tum"), ("lidar", "lidar")):
        np.testing.assert_allclose(read_odometry(tmp_path / f"{name}.txt", format=format), poses, atol=1e-6)
    np.testing.assert_allclose(read_odometry(tmp_path / "graph.g2o"), poses, atol=1e-6)


@pytest.mark.parametrize(
    ("text", "format", "message"),
    [
        ("", "auto", "found an empty file"),
        ("1 2 3\n", "auto", "found 3 numbers a line"),
        ("1 0 0 0 0 1 0 0 0 0 1 0\n", "auto", "12 numbers a line and their axes named, kitti"),
        ("2 0 0 0 0 2 0 0 0 0 2 0\n", "lidar", "expected a rotation and a translation in row 1"),
        ("", "kitti", "expected at least one pose, found none"),
        ("VERTEX_SE3:QUAT 1 0 0 0 0 0 0 1\n", "g2o", "expected vertices 0, 1, 2"),
    ],
)
def test_what_is_no_odometry_is_one_clear_error(tmp_path, text, format, message):
    path = tmp_path / "poses.txt"
    with pytest.raises(FileNotFoundError, match=r"poses\.txt"):
        read_odometry(path, format=format)
    path.write_text(text)
    with pytest.raises(ValueError, match=rf"poses\.txt.*{message}"):
        read_odometry(path, format=format)
