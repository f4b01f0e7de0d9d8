import json
import shutil
from pathlib import Path

import numpy as np
import pytest

import sglpr_jax
from sglpr_jax.data.formats.pose_files import read_tum
from sglpr_jax.data.formats.scan_files import cloud_blocks
from sglpr_jax.data.readers import open_recording
from sglpr_jax.maps import build
from sglpr_jax.maps.build import map_recording
from sglpr_jax.maps.place_map import PlaceMap
from sglpr_jax.models.weights import weights_hash
from sglpr_jax.pose_graph.files import write_tum
from sglpr_jax.retrieval.index import Index
from sglpr_jax.same_place import NEGATIVE_M

from .conftest import WALK, assert_one_line_error


@pytest.fixture
def scans(walk, tmp_path):
    """The folder of the first scans of 08."""
    folder = tmp_path / "08"
    shutil.copytree(walk / "scans", folder)
    for number in range(WALK, 2 * WALK):
        (folder / f"{number:06d}.bin").unlink()
    return folder


@pytest.fixture
def poses(walk, tmp_path):
    """A file of the true positions, the sensor upright and not turned."""
    upright = np.tile(np.eye(4), (WALK, 1, 1))
    upright[:, :3, 3] = read_tum(walk / "poses.tum")[0][:WALK, :3, 3]
    write_tum(tmp_path / "poses.tum", upright, np.arange(float(WALK)))
    return tmp_path / "poses.tum"


@pytest.fixture
def run(scans, poses):
    """Arguments of a map of all scans."""
    return ("map", scans, "--poses", poses, "--spacing-m", "0", "--sensor-height", "1.73")


def moved(poses: Path, metres: float) -> Path:
    """The same poses some metres away."""
    values = np.loadtxt(poses)
    values[:, 1] += metres
    np.savetxt(poses.with_name("moved.tum"), values)
    return poses.with_name("moved.tum")


@pytest.mark.slow
def test_a_scan_of_the_map_finds_itself_in_it(command, scans, poses, run, tmp_path):
    out, answer = tmp_path / "town.safetensors", tmp_path / "pose.json"
    ended = command(*run, "--out", out)
    assert ended.status == 0, ended.error
    assert ended.out.strip() == f"{out}: 8 places, 8 of them from 8 scans of 08"
    query = ("relocalize", scans / "000005.bin", "--map", out, "--out", answer)
    ended = command(*query, "--candidates", "3")
    assert ended.status == 0, ended.error
    assert "08/000005" in ended.out and "000005.bin in the map" in ended.out
    answers = json.loads(answer.read_text())
    assert answers[0]["place"] == "08/000005" and answers[0]["probability"] > 0.5
    first, *others = (np.array(given["world_from_query"])[:3, 3] for given in answers)
    assert all(np.linalg.norm(other - first) > NEGATIVE_M for other in others)
    position = read_tum(poses)[0][5, :3, 3]
    np.testing.assert_allclose(np.array(answers[0]["world_from_query"])[:3, 3], position, atol=0.05)

    assert command(*query, "--sensor-height", "1.83").status == 0
    (best, *_) = json.loads(answer.read_text())
    assert best["place"] == "08/000005" and best["world_from_query"][2][3] == pytest.approx(position[2] + 0.1, abs=1e-6)

    again = (*run, "--add-to", out, "--out", out)
    assert command(*again).out == f"{out}: 8 places, 0 of them from 8 scans of 08\n"  # the same scans are taken once
    assert {path.name for path in tmp_path.iterdir()} == {"08", "town.safetensors", "poses.tum", "pose.json"}


@pytest.mark.slow
def test_a_map_comes_with_a_point_cloud_and_a_grid(command, poses, run, tmp_path):
    cloud, grid = tmp_path / "town.ply", tmp_path / "nav/town.yaml"
    ended = command(*run, "--out", tmp_path / "town.safetensors", "--cloud", cloud, "--grid", grid)
    assert ended.status == 0, ended.error
    points = np.concatenate(list(cloud_blocks(cloud)))
    assert f"{cloud}: {len(points)} points" in ended.out and f"{grid}: " in ended.out
    positions = read_tum(poses)[0][:, :3, 3]
    assert np.all(np.abs(np.median(points, axis=0) - positions.mean(axis=0)) < 15)
    assert 'image: "town.pgm"' in grid.read_text() and (tmp_path / "nav/town.pgm").is_file()

    ended = command(*run, "--out", tmp_path / "other.safetensors", "--cloud", tmp_path / "town.txt")
    assert_one_line_error(ended, "town.txt: expected a name that ends in .ply, .pcd, .las, .laz, found .txt")
    assert not (tmp_path / "other.safetensors").exists()


@pytest.mark.slow
def test_a_stopped_map_over_an_existing_file_continues_to_the_same_map(command, poses, run, tmp_path, monkeypatch):
    def stopped(recording, params, given, *, should_stop, on_progress, **options):
        def show(done):
            on_progress(done)
            if done == stop_at:
                should_stop.signal = 2

        return map_recording(recording, params, given, **options, should_stop=should_stop, on_progress=show)

    before, whole, out = (tmp_path / f"{name}.safetensors" for name in ("before", "whole", "out"))
    first = ("map", run[1], "--poses", moved(poses, 5.0), "--spacing-m", "1e6", "--sensor-height", "1.73")
    assert command(*first, "--out", before).status == 0
    assert command(*run, "--add-to", before, "--out", whole).status == 0
    names = PlaceMap.load(whole).index.ids
    assert names == ["08/000000", *(f"08~2/{scan:06d}" for scan in range(8))]
    shutil.copy(before, out)
    monkeypatch.setattr(build, "map_recording", stopped)
    for stop_at, words in ((3, "4 places, 3 of them from 3 of 8"), (6, "7 places, 3 of them from 6 of 8")):
        ended = command(*run, "--add-to", out, "--out", out)
        assert ended.status == 130 and ended.out == f"{out}: {words} scans of 08\n"
        assert "run the same command again to continue" in ended.error
        assert out.with_suffix(".unfinished").is_dir() and len(PlaceMap.load(out)) == stop_at + 1
    stop_at, content = 3, whole.read_bytes()
    ended = command(*run, "--out", whole)  # a whole map anew, stopped
    assert ended.status == 130 and "unchanged, because it has more places than the 3 found until now" in ended.out
    assert whole.read_bytes() == content and whole.with_suffix(".unfinished").is_dir()
    stop_at = 0
    ended = command(*run, "--add-to", out, "--out", out)
    assert ended.status == 0 and out.read_bytes() == content and not out.with_suffix(".unfinished").exists()


@pytest.mark.slow
def test_a_map_of_another_frame_is_aligned_or_rejected(command, poses, run, town, tmp_path):
    before, out = tmp_path / "before.safetensors", tmp_path / "out.safetensors"
    assert command(*run, "--out", before).status == 0
    add = (*run[:3], moved(poses, 500.0), *run[4:], "--add-to", before, "--out", out)
    assert_one_line_error(command(*add), "places that are 500.0 m away from where the existing map has them")
    assert not out.exists()
    ended = command(*add, "--frame", "align")
    assert ended.status == 0 and "8 places, 0 of them" in ended.out
    np.testing.assert_allclose(PlaceMap.load(out).world_from_place, PlaceMap.load(before).world_from_place)
    for scan in range(8):
        shutil.copy(town / f"sequences/00/velodyne/{scan:06d}.bin", run[1])
    assert_one_line_error(command(*add, "--frame", "align"), "expected places in common with", "found too few")


@pytest.fixture
def places_file(tmp_path):
    """A map of one place, made without describing a scan."""
    params = sglpr_jax.load("sglpr")
    index = Index.empty(256, weights_hash=weights_hash(params))
    index.add(np.ones(256), positions=np.zeros(3))
    mountings = np.array([[1.73, 0, 0, 1.0]])
    images, unknown = np.zeros((1, 152, 152), np.uint8), np.full((1, 2), np.nan)
    PlaceMap(index, images, np.eye(4)[None], mountings, unknown).save(tmp_path / "one.safetensors")
    return tmp_path / "one.safetensors"


def test_wrong_queries_and_maps_are_one_clear_error(command, scans, places_file, tmp_path):
    def ask(scan):
        return command("relocalize", scan, "--map", places_file, "--out", tmp_path / "pose.json")

    np.array([5, 0, 0, 1], np.float32).tofile(tmp_path / "dot.bin")
    assert_one_line_error(ask(tmp_path / "dot.bin"), "dot.bin: expected a scan that shows a place")
    assert_one_line_error(ask(scans), "08: expected one scan or image, found a folder; name a file in it")
    ended = command("relocalize", tmp_path / "dot.bin", "--map", places_file, "--weights", "submaps")
    assert_one_line_error(ended, "one.safetensors: expected descriptors with weights")
    content = places_file.read_bytes()
    places_file.write_bytes(content[:-9] + bytes([content[-9] ^ 1]) + content[-8:])
    assert_one_line_error(ask(tmp_path / "dot.bin"), "expected an index with a valid checksum, found a damaged one")
    assert not (tmp_path / "pose.json").exists()


def test_relocalize_reads_a_frame_of_a_recording(command, town, places_file, monkeypatch):
    """The scan, the mounting and the name are those of the recording. A network can search the map of its teacher."""
    asked = []
    monkeypatch.setattr(PlaceMap, "relocate", lambda self, params, scan, **options: asked.append(scan) or [])
    run = ("relocalize", town, "--seq", "08", "--map", places_file, "--weights", "sglpr-small")
    ended = command(*run, "--frame", "12", "--sensor-height", "2")
    assert_one_line_error(ended, f"frame 12 of {town.name}: expected a scan that shows a place")
    (scan,) = asked
    assert scan.name == "scan 000012 of sequence 08" and scan.mounting.height_m == 2
    np.testing.assert_array_equal(scan.points, open_recording(town, "08").points(12))
    assert_one_line_error(
        command(*run, "--frame", "40"), "08: expected the number of a scan, found 40; it has 40 scans"
    )
