"""Commands remove the motion within scans whose points have times."""

import numpy as np
import pytest

import sglpr_jax
from sglpr_jax.pose_graph.files import write_tum

SCANS, SPEED_MPS, RATE_S = 4, 30.0, 0.1
HEAD = "ply\nformat binary_little_endian 1.0\nelement vertex {}\n"


def write_scan(path, points, ns) -> None:
    """A .ply file with times of points, in nanoseconds since the begin of the scan."""
    fields = "".join(f"property float {axis}\n" for axis in "xyz") + "property uint t\n"
    rows = np.rec.fromarrays([*points.astype("<f4").T, ns.astype("<u4")], names=["x", "y", "z", "t"])
    path.write_bytes(f"{HEAD.format(len(rows))}{fields}end_header\n".encode() + rows.tobytes())


@pytest.fixture
def drive(tmp_path):
    """A folder of skewed scans of one world, one of scans without motion, and the poses of both."""
    rng, poses = np.random.default_rng(0), np.tile(np.eye(4), (SCANS, 1, 1))
    poses[:, 0, 3] = SPEED_MPS * RATE_S * np.arange(SCANS)
    world = rng.uniform([-20, -20, -1], [40, 20, 2], (2000, 3))
    ns = rng.permutation(np.linspace(0, 0.099e9, len(world)))
    folders = tmp_path / "skewed", tmp_path / "still"
    for folder, speed_mps in zip(folders, (SPEED_MPS, 0.0), strict=True):
        folder.mkdir()
        for i, pose in enumerate(poses):
            write_scan(folder / f"{i}.ply", world - pose[:3, 3] - np.outer(1e-9 * ns, [speed_mps, 0, 0]), ns)
        np.savetxt(folder / "times.txt", RATE_S * np.arange(SCANS))
    write_tum(tmp_path / "poses.tum", poses, RATE_S * np.arange(SCANS))
    return *folders, tmp_path / "poses.tum"


def test_deskewed_scans_are_described_like_those_without_motion(command, drive, tmp_path):
    skewed, still, poses = drive
    run = ("embed", "--method", "scan-context", "--out", tmp_path / "out.npz", "--sensor-height", "1.73", "--data")
    found = []
    for flags in ((still,), (skewed,), (skewed, "--deskew", "--odometry", poses)):
        ended = command(*run, *flags)
        assert ended.status == 0, ended.error
        found.append(sglpr_jax.DescriptorFile.load(tmp_path / "out.npz"))
    assert "deskewed: the motion within each scan is removed by its poses\n" in ended.error
    assert "deskewed" in found[2].config and "deskewed" not in found[1].config
    apart = [np.abs(one.descriptors - found[0].descriptors).max(axis=1) for one in found[1:]]
    assert (apart[0] > 0.1).all() and np.median(apart[1]) < 1e-3
