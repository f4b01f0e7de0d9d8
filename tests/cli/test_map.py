import json

import numpy as np
import pytest

import sglpr_jax
from sglpr_jax.data import open_recording
from sglpr_jax.loops.graph_files import write_tum
from sglpr_jax.loops.places import PlaceMap
from sglpr_jax.models.weights import weights_hash
from sglpr_jax.retrieval.index import Index

from .conftest import SCANS, assert_one_line_error


@pytest.fixture
def poses(town, tmp_path):
    """A file of the true positions of 08, the sensor upright and not turned."""
    recording = open_recording(town, "08")
    upright = np.tile(np.eye(4), (SCANS, 1, 1))
    upright[:, :3, 3] = recording.positions
    write_tum(tmp_path / "poses.tum", upright, recording.times)
    return tmp_path / "poses.tum"


@pytest.mark.slow
def test_a_scan_of_the_map_finds_itself_in_it(command, town, poses, tmp_path):
    out = tmp_path / "town.safetensors"
    ended = command("map", town, "--seq", "08", "--poses", poses, "--out", out, "--spacing-m", "0")
    assert ended.status == 0, ended.error
    assert ended.out.strip() == f"{out}: 40 places, 40 of them from 40 scans of 08"
    scan = town / "sequences/08/velodyne/000020.bin"
    ended = command("relocalize", scan, "--map", out, "--out", tmp_path / "pose.json", "--candidates", "3")
    assert ended.status == 0, ended.error
    assert "08/000020" in ended.out and "000020.bin in the map" in ended.out
    answers = json.loads((tmp_path / "pose.json").read_text())
    assert len(answers) == 3 and answers[0]["place"] == "08/000020" and answers[0]["probability"] > 0.99
    position = open_recording(town, "08").positions[20]
    np.testing.assert_allclose(np.array(answers[0]["world_from_query"])[:3, 3], position, atol=0.05)

    higher = ("--sensor-height", "1.83", "--out", tmp_path / "higher.json")
    assert command("relocalize", scan, "--map", out, *higher).status == 0
    best = json.loads((tmp_path / "higher.json").read_text())[0]
    assert best["place"] == "08/000020" and best["world_from_query"][2][3] == pytest.approx(position[2] + 0.1, abs=1e-6)

    again = ("map", town, "--seq", "08", "--poses", poses, "--add-to", out, "--out", out)
    assert command(*again).status == 0
    assert len(PlaceMap.load(out)) > 40


def test_a_scan_without_ground_tells_no_height(command, places_file, tmp_path):
    scan = tmp_path / "sky.bin"
    np.random.default_rng(0).normal(scale=9, size=(200, 4)).astype(np.float32).tofile(scan)
    ended = command("relocalize", scan, "--map", places_file, "--sensor-height", "estimate")
    assert_one_line_error(ended, "sky.bin", "expected ground that tells the sensor's height")


@pytest.fixture
def places_file(tmp_path):
    """A map of one place, made without describing a scan."""
    params = sglpr_jax.load("rings")
    index = Index.empty(256, weights_hash=weights_hash(params))
    index.add(np.ones(256), positions=np.zeros(3))
    mountings = np.array([[1.73, 0, 0, 1.0]])
    PlaceMap(index, np.zeros((1, 152, 152), np.uint8), np.eye(4)[None], mountings).save(tmp_path / "one.safetensors")
    return tmp_path / "one.safetensors"


def test_wrong_input_is_one_clear_error(command, town, poses, tmp_path):
    run = ("map", town, "--seq", "08", "--poses", poses)
    assert_one_line_error(command(*run, "--out", tmp_path / "town.npz"), "--out", ".safetensors", "town.npz")
    assert_one_line_error(command(*run, "--out", tmp_path / "a.safetensors", "--add-to", tmp_path / "none"), "none")
    scan = town / "sequences/08/velodyne/000020.bin"
    (tmp_path / "broken.safetensors").write_bytes(b"no map at all")
    ended = command("relocalize", scan, "--map", tmp_path / "broken.safetensors")
    assert_one_line_error(ended, "broken.safetensors", "expected an index")
    assert_one_line_error(command("relocalize", scan, "--map", tmp_path / "none"), "none", "expected an index")
    assert list(tmp_path.glob("a.safetensors")) == []
