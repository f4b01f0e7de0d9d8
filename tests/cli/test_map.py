import errno
import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from rich.console import Console

import sglpr_jax
from sglpr_jax.cli.relocalize import _table
from sglpr_jax.data.readers import open_recording
from sglpr_jax.files import exclusive_lock
from sglpr_jax.loops.closure import Loop
from sglpr_jax.maps import build as recorded
from sglpr_jax.maps.build import map_recording
from sglpr_jax.maps.place_map import PlaceMap, Relocated
from sglpr_jax.models.weights import weights_hash
from sglpr_jax.pose_graph.files import write_tum
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
    assert len(answers) == 3 and answers[0]["place"] == "08/000020" and answers[0]["probability"] > 0.5
    position = open_recording(town, "08").positions[20]
    np.testing.assert_allclose(np.array(answers[0]["world_from_query"])[:3, 3], position, atol=0.05)

    higher = ("--sensor-height", "1.83", "--out", tmp_path / "higher.json")
    assert command("relocalize", scan, "--map", out, *higher).status == 0
    best = json.loads((tmp_path / "higher.json").read_text())[0]
    assert best["place"] == "08/000020" and best["world_from_query"][2][3] == pytest.approx(position[2] + 0.1, abs=1e-6)

    points = np.fromfile(scan, "<f4").reshape(-1, 4)
    rings, seconds = np.arange(len(points)) % 64, np.linspace(0, 0.1, len(points))
    (tmp_path / "of_six").mkdir()
    np.column_stack([points, rings, seconds]).astype("<f4").tofile(tmp_path / "of_six" / "000020.bin")
    six = ("relocalize", tmp_path / "of_six" / "000020.bin", "--map", out, "--out", tmp_path / "of_six" / "pose.json")
    assert command(*six, "--candidates", "3").status == 0
    assert json.loads((tmp_path / "of_six" / "pose.json").read_text()) == answers  # what a point is was found out
    shutil.rmtree(tmp_path / "of_six")

    again = ("map", town, "--seq", "08", "--poses", poses, "--add-to", out, "--out", out)
    for _ in range(2):  # the same scans are taken once
        assert command(*again).out == f"{out}: 40 places, 0 of them from 40 scans of 08\n"
    assert len(PlaceMap.load(out)) == 40
    assert {path.name for path in tmp_path.iterdir()} == {"town.safetensors", "poses.tum", "pose.json", "higher.json"}


@pytest.mark.slow
def test_bad_scans_are_told_and_skipped(command, town, poses, tmp_path):
    folder = tmp_path / "town"
    shutil.copytree(town / "sequences" / "08", folder / "sequences" / "08")
    for scan in ("000003", "000021"):
        (folder / "sequences/08/velodyne" / f"{scan}.bin").write_bytes(b"half")
    out = tmp_path / "town.safetensors"
    run = ("map", folder, "--poses", poses, "--out", out, "--spacing-m", "0")
    assert_one_line_error(command(*run), "000003.bin")
    assert not out.exists()
    ended = command(*run, "--skip-bad")
    assert ended.status == 0, ended.error
    assert ended.out == f"{out}: 38 places, 38 of them from 40 scans of 08, 2 scans skipped\n"
    assert [line[:14] for line in ended.error.splitlines() if "skipped" in line] == ["skipped 000003", "skipped 000021"]
    assert not out.with_suffix(".unfinished").exists()


@pytest.mark.slow
def test_ctrl_c_keeps_what_was_found_and_the_same_command_goes_on(command, town, poses, tmp_path, monkeypatch):
    def stopped(recording, params, given, *, should_stop, on_progress, **options):
        def show(done):
            on_progress(done)
            if done == stop_at:
                should_stop.signal = 2

        return map_recording(recording, params, given, **options, should_stop=should_stop, on_progress=show)

    out, other = tmp_path / "town.safetensors", tmp_path / "whole.safetensors"
    run = ("map", town, "--seq", "08", "--poses", poses, "--spacing-m", "0")
    assert command(*run, "--out", other).status == 0
    monkeypatch.setattr(recorded, "map_recording", stopped)
    add_to = ()
    for stop_at, words in ((10, "10 places, 10 of them from 10 of 40"), (25, "25 places, 15 of them from 25 of 40")):
        ended = command(*run, *add_to, "--out", out)
        assert ended.status == 130 and ended.out == f"{out}: {words} scans of 08\n"
        assert "run the same command again to continue" in ended.error
        add_to = ("--add-to", out)
        assert out.with_suffix(".unfinished").is_dir() and len(PlaceMap.load(out)) == stop_at
    stop_at, whole = 10, other.read_bytes()
    ended = command(*run, "--out", other)  # the whole map anew, stopped
    assert ended.status == 130 and "unchanged, because it has more places than the 10 found until now" in ended.out
    assert other.read_bytes() == whole and other.with_suffix(".unfinished").is_dir()
    stop_at = 0
    ended = command(*run, *add_to, "--out", out)
    assert ended.status == 0 and ended.out == f"{out}: 40 places, 15 of them from 40 scans of 08\n"
    assert out.read_bytes() == other.read_bytes()
    assert not out.with_suffix(".unfinished").exists()


@pytest.mark.slow
def test_a_stopped_map_of_a_name_that_is_taken_ends_as_if_not_stopped(command, town, poses, tmp_path, monkeypatch):
    def stopped(recording, params, given, *, should_stop, on_progress, **options):
        def show(done):
            on_progress(done)
            should_stop.signal = 2 if done == 10 else should_stop.signal

        return map_recording(recording, params, given, **options, should_stop=should_stop, on_progress=show)

    values = np.loadtxt(poses)
    values[:, 1] += 5
    np.savetxt(tmp_path / "moved.tum", values)
    before, whole, out = (tmp_path / f"{name}.safetensors" for name in ("before", "whole", "out"))
    run = ("map", town, "--seq", "08", "--out")
    assert command(*run, before, "--poses", tmp_path / "moved.tum", "--spacing-m", "1e6").status == 0
    run = (*run[:-1], "--poses", poses, "--spacing-m", "0")
    assert command(*run, "--add-to", before, "--out", whole).status == 0
    shutil.copy(before, out)
    with monkeypatch.context() as patch:
        patch.setattr(recorded, "map_recording", stopped)
        assert command(*run, "--add-to", out, "--out", out).status == 130
    assert command(*run, "--add-to", out, "--out", out).status == 0
    assert out.read_bytes() == whole.read_bytes()
    names = PlaceMap.load(out).index.ids
    assert names[0] == "08/000000" and names[1:] == [f"08~2/{scan:06d}" for scan in range(40)]


@pytest.mark.slow
def test_a_map_of_another_frame_is_aligned_or_rejected(command, town, poses, tmp_path):
    values = np.loadtxt(poses)
    values[:, 1] += 500
    np.savetxt(tmp_path / "moved.tum", values)
    before, out = tmp_path / "before.safetensors", tmp_path / "out.safetensors"
    run = ("map", town, "--seq", "08", "--spacing-m", "0", "--poses")
    assert command(*run, poses, "--out", before).status == 0
    add = (*run, tmp_path / "moved.tum", "--add-to", before, "--out", out)
    assert_one_line_error(command(*add), "places that are 500.0 m away from where the existing map has them")
    assert not out.exists()
    ended = command(*add, "--frame", "align")
    assert ended.status == 0 and f"{SCANS} places, 0 of them" in ended.out
    np.testing.assert_allclose(PlaceMap.load(out).world_from_place, PlaceMap.load(before).world_from_place)
    other = ("map", town, "--seq", "00", "--poses", poses, "--add-to", before, "--out", out, "--frame", "align")
    assert_one_line_error(command(*other), "expected places in common with", "found too few")


def test_two_processes_do_not_make_one_map(command, town, poses, tmp_path):
    out = tmp_path / "town.safetensors"
    with exclusive_lock(out.with_suffix(".unfinished")):
        ended = command("map", town, "--seq", "08", "--poses", poses, "--out", out)
    assert_one_line_error(ended, "town.unfinished: expected exclusive use, found another process at work")
    assert [path.name for path in tmp_path.iterdir()] == ["poses.tum"]


def test_folders_for_files_and_files_for_folders_are_one_clear_error(command, town, poses, places_file, tmp_path):
    (tmp_path / "town.safetensors").mkdir()
    run = ("map", town, "--seq", "08", "--poses")
    ended = command(*run, poses, "--out", tmp_path / "town.safetensors")
    assert_one_line_error(ended, "town.safetensors: expected a file to write, found a folder")
    ended = command(*run, poses, "--out", poses / "town.safetensors")
    assert_one_line_error(ended, "poses.tum: expected a folder to write into, found a file")
    out = ("--out", tmp_path / "new.safetensors")
    assert_one_line_error(command(*run, tmp_path, *out), f"{tmp_path}: expected odometry, found a folder")
    assert_one_line_error(command(*run, poses, *out, "--add-to", tmp_path), "expected an index, found a folder")
    scans = town / "sequences/08/velodyne"
    ended = command("relocalize", scans, "--map", places_file)
    assert_one_line_error(
        ended, "velodyne: expected one scan or image, found a folder; name a file in it, or use --frame"
    )
    ended = command("relocalize", scans / "000020.bin", "--map", tmp_path)
    assert_one_line_error(ended, "expected an index, found a folder")
    assert {path.name for path in tmp_path.iterdir()} == {"town.safetensors", "one.safetensors", "poses.tum"}


def test_a_scan_without_ground_tells_no_height(command, places_file, tmp_path):
    scan = tmp_path / "sky.bin"
    np.random.default_rng(0).normal(scale=9, size=(200, 4)).astype(np.float32).tofile(scan)
    ended = command("relocalize", scan, "--map", places_file, "--sensor-height", "estimate")
    assert_one_line_error(ended, "sky.bin", "expected ground to estimate the sensor's height")


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


def test_brackets_in_a_name_are_no_style(capsys):
    loop = Loop(1, 0, np.eye(4), np.eye(6), 0.9)
    answers = [Relocated("[red]sunday/000003", np.eye(4), loop)]
    Console(width=140).print(_table("[bold]scan.bin", answers))
    shown = capsys.readouterr().out
    assert "[red]sunday/000003" in shown and "[bold]scan.bin in the map" in shown


def test_answers_that_share_the_probability_say_so(capsys, command, tmp_path):
    far = np.eye(4)
    far[0, 3] = 55.0
    answers = [
        Relocated(f"08/{i:06d}", pose, Loop(2, i, pose, np.eye(6), 0.5)) for i, pose in enumerate((np.eye(4), far))
    ]
    for few, words in ((answers, True), (answers[:1], False)):
        Console(width=140).print(_table("scan.bin", few))
        assert ("Answers more than 20 m apart share the probability" in capsys.readouterr().out) == words
    ended = command("relocalize", "scan.bin", "--map", tmp_path / "map", "--candidates", "1000000000")
    assert_one_line_error(ended, "--candidates: expected a number from 1 up to 1000, found 1000000000")


def test_a_scan_of_one_point_and_a_map_of_others_or_with_a_flipped_byte(command, places_file, tmp_path):
    scan = tmp_path / "dot.bin"
    np.array([5, 0, 0, 1], np.float32).tofile(scan)
    run = ("relocalize", scan, "--map", places_file)
    assert_one_line_error(command(*run, "--out", tmp_path / "pose.json"), "dot.bin: expected a scan that shows a place")
    assert not (tmp_path / "pose.json").exists()
    assert_one_line_error(
        command(*run, "--weights", "circular"), "one.safetensors: expected descriptors of the weights"
    )
    content = places_file.read_bytes()
    places_file.write_bytes(content[:-9] + bytes([content[-9] ^ 1]) + content[-8:])
    assert_one_line_error(
        command(*run), "one.safetensors: expected an index with a valid checksum, found a damaged one"
    )


@pytest.mark.slow
def test_a_full_disk_leaves_the_map_as_it_was_and_what_was_seen(
    command, town, poses, places_file, tmp_path, monkeypatch
):
    before, write = places_file.read_bytes(), Path.write_bytes

    def full(path, content):
        if path.name.startswith(".one.safetensors."):
            write(path, content[:100])
            raise OSError(errno.ENOSPC, "No space left on device")
        return write(path, content)

    run = ("map", town, "--seq", "08", "--poses", poses, "--out", places_file, "--add-to", places_file)
    with monkeypatch.context() as patch:
        patch.setattr(Path, "write_bytes", full)
        ended = command(*run)
    assert_one_line_error(ended, "one.safetensors: cannot be written: No space left on device")
    assert places_file.read_bytes() == before
    assert {path.name for path in tmp_path.iterdir()} == {"one.safetensors", "one.unfinished", "poses.tum"}
    assert command(*run).status == 0
    assert len(PlaceMap.load(places_file)) > 1 and not (tmp_path / "one.unfinished").exists()


def test_wrong_input_is_one_clear_error(command, town, poses, tmp_path):
    run = ("map", town, "--seq", "08", "--poses", poses)
    assert_one_line_error(command(*run, "--out", tmp_path / "town.npz"), "--out", ".safetensors", "town.npz")
    assert_one_line_error(command(*run, "--out", tmp_path / "a.safetensors", "--add-to", tmp_path / "none"), "none")
    late = tmp_path / "late.tum"
    late.write_text("0 0 0 0 0 0 0 1\n2 0 0 0 0 0 0 1\n1 0 0 0 0 0 0 1\n")
    run = ("map", town, "--seq", "08", "--poses", late, "--out", tmp_path / "a.safetensors")
    assert_one_line_error(command(*run), "late.tum, row 3: expected a time >= 2.0, found 1.0")
    scan = town / "sequences/08/velodyne/000020.bin"
    (tmp_path / "broken.safetensors").write_bytes(b"no map at all")
    ended = command("relocalize", scan, "--map", tmp_path / "broken.safetensors")
    assert_one_line_error(ended, "broken.safetensors", "expected an index")
    assert_one_line_error(command("relocalize", scan, "--map", tmp_path / "none"), "none", "expected an index")
    assert list(tmp_path.glob("a.safetensors")) == []


def test_a_frame_of_a_recording_is_asked_in_the_map(command, town, places_file, monkeypatch):
    """The scan, the mounting and the name are those of the recording."""
    asked = []
    monkeypatch.setattr(PlaceMap, "relocate", lambda self, params, record, **options: asked.append(record) or [])
    ended = command("relocalize", town, "--seq", "08", "--frame", "12", "--map", places_file, "--sensor-height", "2")
    assert_one_line_error(ended, f"frame 12 of {town.name}: expected a scan that shows a place")
    (record,) = asked
    assert record.name == "scan 000012 of sequence 08" and record.mounting.height_m == 2
    np.testing.assert_array_equal(record.points, open_recording(town, "08").points(12))
    ended = command("relocalize", town, "--seq", "08", "--frame", "40", "--map", places_file)
    assert_one_line_error(ended, "08: expected the number of a scan, found 40; it has 40 scans from 0 to 39")
