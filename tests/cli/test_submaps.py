"""Commands describe submaps in place of scans."""

import json

import numpy as np
import pytest

import sglpr_jax
from sglpr_jax.pose_graph.files import write_tum

from .conftest import assert_one_line_error

SCANS, STEP_M = 6, 2.0


@pytest.fixture
def drive(tmp_path):
    """A folder of scans of one world, each with other points of it, and their true poses."""
    rng = np.random.default_rng(0)
    folder, poses = tmp_path / "drive", np.tile(np.eye(4), (SCANS, 1, 1))
    poses[:, 0, 3] = STEP_M * np.arange(SCANS)
    boxes = rng.uniform([-20, -20], [30, 20], (40, 2))
    folder.mkdir()
    for i, pose in enumerate(poses):
        walls = np.repeat(boxes, 20, axis=0) + rng.normal(0, 0.3, (800, 2))
        points = np.column_stack([walls, rng.uniform(-1, 2, 800)]) - pose[:3, 3]
        np.column_stack([points, np.ones(800)]).astype("<f4").tofile(folder / f"{i:06d}.bin")
    write_tum(tmp_path / "poses.tum", poses, 0.1 * np.arange(SCANS))
    return folder, tmp_path / "poses.tum"


def test_embed_describes_submaps(command, drive, tmp_path):
    folder, poses = drive
    run = ("embed", "--method", "scan-context", "--data", folder, "--out", tmp_path / "out.npz")
    assert command(*run).status == 0
    single = sglpr_jax.DescriptorFile.load(tmp_path / "out.npz")
    assert command(*run, "--submap-m", "0").status == 0
    np.testing.assert_array_equal(sglpr_jax.DescriptorFile.load(tmp_path / "out.npz").descriptors, single.descriptors)
    ended = command(*run, "--submap-m", "10", "--odometry", poses)
    assert ended.status == 0, ended.error
    assert "submaps: the scans of the last 10 m, 1 m apart, in the frame of the newest scan" in ended.error
    file = sglpr_jax.DescriptorFile.load(tmp_path / "out.npz")
    assert file.config["submaps"].startswith("10 1 ") and "submaps" not in single.config
    filled = [np.count_nonzero(one.descriptors[-1]) for one in (file, single)]
    assert filled[0] > filled[1]


@pytest.mark.slow
def test_a_submap_is_located_in_a_map_of_submaps(command, drive, tmp_path):
    (folder, poses), out = drive, tmp_path / "town.safetensors"
    submap = ("--submap-m", "6", "--weights", "circular", "--sensor-height", "1.73")
    ended = command("map", folder, "--poses", poses, "--out", out, *submap)
    assert ended.status == 0, ended.error
    query = ("--frame", "4", "--map", out, "--odometry", poses, "--out", tmp_path / "pose.json")
    ended = command("relocalize", folder, *query, *submap)
    assert ended.status == 0, ended.error
    best = json.loads((tmp_path / "pose.json").read_text())[0]
    assert best["place"] == "drive/000004"
    assert best["world_from_query"][0][3] == pytest.approx(4 * STEP_M, abs=0.05)
    ended = command("loops", folder, "--odometry", poses, "--out", tmp_path / "found", *submap)
    assert ended.status == 0, ended.error
    assert json.loads((tmp_path / "found" / "command.json").read_text())["submap-m"] == 6


def test_submaps_without_poses_are_one_clear_error(command, drive, tmp_path):
    folder, poses = drive
    run = ("embed", "--method", "scan-context", "--data", folder, "--out", tmp_path / "out.npz")
    assert_one_line_error(command(*run, "--submap-m", "10"), "expected poses with rotations for --submap-m, found none")
    assert_one_line_error(
        command(*run, "--odometry", poses), "poses.tum: expected --submap-m or --deskew with --odometry, found neither"
    )
    assert_one_line_error(
        command(*run, "--odometry", poses, "--submap-m", "-1"), "expected length_m in metres, more than 0"
    )
    lone = ("relocalize", folder / "000000.bin", "--map", tmp_path / "no.safetensors", "--submap-m", "10")
    assert_one_line_error(command(*lone), "000000.bin: expected --frame with --submap-m, found a single")
    assert not (tmp_path / "out.npz").exists()
