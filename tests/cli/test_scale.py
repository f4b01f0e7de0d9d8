"""Commands scale scans, keep the scale in their files, and compare only equals."""

import json

import pytest

import sglpr_jax
from sglpr_jax.maps.place_map import PlaceMap

from .conftest import assert_one_line_error
from .test_submaps import drive  # noqa: F401


def test_embed_keeps_the_scale(command, drive, tmp_path):  # noqa: F811
    run = ("embed", "--method", "scan-context", "--data", drive[0], "--out", tmp_path / "out.npz")
    assert command(*run).status == 0
    single = sglpr_jax.DescriptorFile.load(tmp_path / "out.npz")
    ended = command(*run, "--scale", "2")
    assert ended.status == 0, ended.error
    file = sglpr_jax.DescriptorFile.load(tmp_path / "out.npz")
    assert (file.scale, single.scale) == (2, 1) and (file.descriptors != single.descriptors).any()
    ended = command(*run, "--scale", "auto")  # the scans show 20 m
    assert ended.status == 0 and "scale: 1, chosen by the ranges of the scans" in ended.error


@pytest.mark.slow
def test_a_scan_is_located_in_a_map_of_its_scale(command, drive, tmp_path):  # noqa: F811
    (folder, poses), out, found = drive, tmp_path / "town.safetensors", tmp_path / "found"
    same = ("--scale", "2", "--weights", "circular", "--sensor-height", "1.73")
    ended = command("map", folder, "--poses", poses, "--out", out, *same)
    assert ended.status == 0, ended.error
    assert PlaceMap.load(out).scale == 2
    query = ("relocalize", folder / "000004.bin", "--map", out, "--weights", "circular")
    ended = command(*query, "--out", tmp_path / "pose.json")
    assert ended.status == 0, ended.error
    best = json.loads((tmp_path / "pose.json").read_text())[0]
    assert best["place"] == "drive/000004" and best["world_from_query"][0][3] == pytest.approx(8.0, abs=0.05)
    wrong = "town.safetensors: expected scale {}, found scale 2: descriptors of scans with different scales"
    assert_one_line_error(command(*query, "--scale", "4"), wrong.format(4))
    more = ("map", folder, "--poses", poses, "--add-to", out, "--out", out, "--weights", "circular")
    assert_one_line_error(command(*more), wrong.format(1))
    ended = command("loops", folder, "--odometry", poses, "--out", found, *same)
    assert ended.status == 0, ended.error
    assert ", scale 2" in ended.out and json.loads((found / "command.json").read_text())["scale"] == 2
