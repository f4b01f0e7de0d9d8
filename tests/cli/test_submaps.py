"""Commands describe submaps and scaled scans, and compare only descriptors of one scale."""

import json

import numpy as np
import pytest

import sglpr_jax
from sglpr_jax.maps.place_map import PlaceMap
from sglpr_jax.pose_graph.files import write_tum

from .conftest import assert_one_line_error

SCANS, STEP_M = 6, 2.0
HEIGHT = ("--weights", "sglpr-small", "--sensor-height", "1.73")


@pytest.fixture(scope="module")
def drive(tmp_path_factory):
    """A folder of scans of one world, each with other points of it, and their true poses."""
    rng = np.random.default_rng(0)
    folder, poses = tmp_path_factory.mktemp("scans") / "drive", np.tile(np.eye(4), (SCANS, 1, 1))
    poses[:, 0, 3] = STEP_M * np.arange(SCANS)
    boxes = rng.uniform([-20, -20], [30, 20], (40, 2))
    folder.mkdir()
    for i, pose in enumerate(poses):
        walls = np.repeat(boxes, 20, axis=0) + rng.normal(0, 0.3, (800, 2))
        points = np.column_stack([walls, rng.uniform(-1, 2, 800)]) - pose[:3, 3]
        np.column_stack([points, np.ones(800)]).astype("<f4").tofile(folder / f"{i:06d}.bin")
    write_tum(folder.parent / "poses.tum", poses, 0.1 * np.arange(SCANS))
    return folder, folder.parent / "poses.tum"


def test_embed_describes_submaps_and_keeps_the_scale(command, drive, tmp_path):
    folder, poses = drive
    run = ("embed", "--method", "scan-context", "--data", folder, "--out", tmp_path / "out.npz")

    def embedded(*flags, said=""):
        ended = command(*run, *flags)
        assert ended.status == 0 and said in ended.error, ended.error
        return sglpr_jax.DescriptorFile.load(tmp_path / "out.npz")

    single = embedded()
    np.testing.assert_array_equal(embedded("--submap-m", "0").descriptors, single.descriptors)
    said = "submaps: the scans of the last 10 m, 1 m apart, in the frame of the newest scan"
    file = embedded("--submap-m", "10", "--odometry", poses, said=said)
    assert file.config["submaps"].startswith("10 1 ") and "submaps" not in single.config
    assert np.count_nonzero(file.descriptors[-1]) > np.count_nonzero(single.descriptors[-1])
    scaled = embedded("--scale", "2")
    assert (scaled.scale, single.scale) == (2, 1) and (scaled.descriptors != single.descriptors).any()
    embedded("--scale", "auto", said="scale: 1, chosen by the ranges of the scans")  # they show 20 m


@pytest.mark.slow
def test_a_scan_is_located_only_in_a_map_of_the_same_scale(command, drive, tmp_path):
    (folder, poses), out, found = drive, tmp_path / "town.safetensors", tmp_path / "found"
    flags = ("--scale", "2", "--submap-m", "6")
    ended = command("map", folder, "--poses", poses, "--out", out, *flags, *HEIGHT)
    assert ended.status == 0, ended.error
    query = ("relocalize", folder, "--frame", "4", "--map", out, *HEIGHT)
    ended = command(*query, "--odometry", poses, *flags, "--out", tmp_path / "pose.json")
    assert ended.status == 0, ended.error
    best = json.loads((tmp_path / "pose.json").read_text())[0]
    assert best["place"] == "drive/000004"
    assert best["world_from_query"][0][3] == pytest.approx(4 * STEP_M, abs=0.05)
    ended = command("loops", folder, "--odometry", poses, "--out", found, "--no-register", *flags, *HEIGHT)
    assert ended.status == 0, ended.error
    values = json.loads((found / "command.json").read_text())
    assert (values["scale"], values["submap-m"]) == (2, 6)
    assert ", scale 2" in ended.out and PlaceMap.load(out).scale == 2
    wrong = "town.safetensors: expected descriptors with scale 2, found {}: they are not comparable"
    assert_one_line_error(command(*query, "--scale", "4"), wrong.format(4))
    more = ("map", folder, "--poses", poses, "--add-to", out, "--out", out, "--weights", "sglpr-small")
    assert_one_line_error(command(*more), wrong.format(1))
