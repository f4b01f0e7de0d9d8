"""A search that was stopped anywhere goes on and ends like one that was not; scans that cannot be read are left out."""

import dataclasses
import functools
import os
from pathlib import Path

import numpy as np
import pytest
from recordings import with_points

import sglpr_jax
from sglpr_jax.data.mounting import Mounting
from sglpr_jax.data.warning import DataWarning
from sglpr_jax.loops import acceptance, checkpoint, search
from sglpr_jax.loops.config import CandidateConfig, DetectorConfig
from sglpr_jax.loops.probability import AdditiveModel, Curve, LoopModel
from sglpr_jax.pose_graph.folder import write_found
from sglpr_jax.registration.gicp import Registration
from sglpr_jax.retrieval.index import Index

from .kept import WANTED, fake_frames, keep, recalled

ROWS = (*range(0, 24, 2), *range(1, 24, 2))
"""A drive that is driven twice."""
ALWAYS = LoopModel(AdditiveModel({"deviation": Curve((0.0,), (0.0,))}, 10.0), "everything")
find_loops = functools.partial(search.find_loops, model=ALWAYS)
"""Every candidate is probable, so that the loops depend on nothing but what is kept."""
CONFIG = DetectorConfig(candidates=CandidateConfig(recent_m=20.0))
EMPTY = Index.empty(4, weights_hash="w")


@pytest.fixture(scope="module")
def twice(drive):
    """The recording, and its odometry."""
    parts = {name: tuple(getattr(drive, name)[i] for i in ROWS) for name in ("ids", "paths")}
    recording = dataclasses.replace(
        drive, **parts, label_paths=(), positions=drive.positions[list(ROWS)], times=np.arange(24.0) / 10
    )
    clouds = {path: drive.points(drive.paths.index(path)) for path in parts["paths"]}
    return with_points(recording, clouds.__getitem__), drive.poses.world_from_lidar[list(ROWS)]


@pytest.fixture(autouse=True)
def _small_files(monkeypatch):
    monkeypatch.setattr(checkpoint, "FRAMES", 5)


@pytest.fixture(scope="module")
def whole(twice, params, tmp_path_factory):
    """What a run finds that is not stopped, and its files."""
    found = find_loops(twice[0], params, odometry=twice[1], config=CONFIG)
    return found, contents(found, tmp_path_factory.mktemp("whole"))


def contents(found, folder) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in write_found(found, folder)}


def stopping_after(frames: int, asked: list):
    def should_stop():
        asked.append(None)
        return len(asked) > frames

    return should_stop


@pytest.mark.slow
def test_a_run_that_is_stopped_again_and_again_ends_as_if_it_had_not_been(twice, params, whole, tmp_path):
    recording, odometry = twice
    expected, files = whole
    assert len(expected.loops) >= 8
    options = {"odometry": odometry, "config": CONFIG, "kept_in": tmp_path / "kept"}
    reached = []
    for frames in (3, 4, 9, 100):
        done = []
        found = find_loops(
            recording, params, **options, should_stop=stopping_after(frames, []), on_progress=done.append
        )
        reached.append(found.sessions[0].frames)
        assert done[0] == (reached[-2] if len(reached) > 1 else 1)
    assert reached == [3, 7, 16, 24]
    assert contents(found, tmp_path / "found") == files
    (tmp_path / "kept" / f".000024.safetensors.{32 * 'a'}.tmp").write_bytes(b"half")
    checkpoint.remove(tmp_path / "kept")
    assert not (tmp_path / "kept").exists()


@pytest.mark.slow
def test_a_run_that_forgets_scans_goes_on_too_and_other_limits_are_other_settings(twice, params, tmp_path):
    recording, odometry = twice
    config = dataclasses.replace(CONFIG, keyframe_m=1.0, max_places=14)
    whole = find_loops(recording, params, odometry=odometry, config=config)
    assert len(whole.loops) >= 4
    options = {"odometry": odometry, "kept_in": tmp_path / "kept"}
    for frames in (13, 6, 100):
        found = find_loops(recording, params, **options, config=config, should_stop=stopping_after(frames, []))
    assert found.whole and contents(found, tmp_path / "found") == contents(whole, tmp_path / "whole")
    other = dataclasses.replace(config, max_places=13)
    with pytest.warns(DataWarning, match="found another max_places, acceptance"):
        find_loops(recording, params, **options, config=other, should_stop=stopping_after(1, []))


@pytest.mark.slow
def test_what_is_damaged_is_seen_again_and_what_others_made_is_thrown_away(twice, params, whole, tmp_path):
    recording, odometry = twice
    kept = tmp_path / "kept"
    options = {"config": CONFIG, "kept_in": kept}
    find_loops(recording, params, odometry=odometry, **options, should_stop=stopping_after(16, []))
    files = sorted(path.name for path in kept.iterdir())
    assert files == [f"{first:06d}.safetensors" for first in (0, 5, 10, 15)] + ["settings.json"]
    content = (kept / "000010.safetensors").read_bytes()
    (kept / "000010.safetensors").write_bytes(content[:-1] + bytes([content[-1] ^ 1]))
    done = []
    found = find_loops(recording, params, odometry=odometry, **options, on_progress=done.append)
    assert done[0] == 10 and contents(found, tmp_path / "found") == whole[1]

    (kept / "mine.txt").write_text("not to be removed")
    for change in ({"odometry": odometry + 0.0, "words": ""}, {"odometry": None, "words": "odometry"}):
        done, words = [], change.pop("words")
        if words:
            with pytest.warns(DataWarning, match=f"the same settings, found another {words}"):
                find_loops(recording, params, **change, **options, on_progress=done.append)
        else:
            find_loops(recording, params, **change, **options, on_progress=done.append)
        assert done[0] == (1 if words else 24)
    assert (kept / "mine.txt").exists()


@pytest.mark.slow
def test_scans_that_cannot_be_read_are_left_out_and_frames_keep_their_numbers(twice, params, whole, tmp_path):
    recording, odometry = twice
    broken = {recording.paths[row] for row in (0, 6, 17)}

    def points_of(path):
        if path in broken:
            raise ValueError("expected a whole scan, found half of one")
        return recording.read(path, None, False).points

    bad = with_points(recording, points_of)
    options = {"odometry": odometry, "config": CONFIG, "kept_in": tmp_path / "kept"}
    with pytest.raises(ValueError, match="found half of one"):
        find_loops(bad, params, **options)
    said = []
    options["on_bad_scan"] = lambda scan, error: said.append((scan, str(error)))
    first = find_loops(bad, params, **options, should_stop=stopping_after(9, []))
    assert first.sessions[0].frames == 9
    found = find_loops(bad, params, **options)
    ids = tuple(recording.ids[row] for row in (0, 6, 17))
    assert found.sessions[0].skipped == ids and [scan for scan, _ in said] == list(ids)
    assert str(found).endswith("3 scans skipped")
    frames = {frame for loop in found.loops for frame in (loop.query, loop.match)}
    assert len(found.loops) >= 5 and not frames & {0, 6, 17}
    for loop in found.loops:
        assert np.linalg.norm(recording.positions[loop.query] - recording.positions[loop.match]) < 12
    with pytest.raises(ValueError, match="found half of one"):  # without leave to skip, the scan is read again
        find_loops(bad, params, odometry=odometry, config=CONFIG, kept_in=tmp_path / "kept")
    broken |= set(recording.paths)
    with pytest.raises(ValueError, match="expected at least one readable scan, found none"):
        find_loops(bad, params, config=CONFIG, on_bad_scan=lambda scan, error: None)
    for cloud, words in (
        (np.full((1, 3), 5, np.float32), "08: expected at least one scan that is not empty, found 24 empty ones"),
        (np.full((9, 3), np.nan, np.float32), "scan 000000 of sequence 08: expected finite points, found none among 9"),
    ):
        with pytest.raises(ValueError, match=words):
            find_loops(with_points(recording, lambda path, cloud=cloud: cloud), params, config=CONFIG)


@pytest.mark.parametrize("name", ["mine.txt", "2024.safetensors", ".mine.tmp", "settings.json", "000001.safetensors/a"])
def test_a_folder_of_somebody_else_is_refused_and_left_as_it_is(tmp_path, name):
    folder = tmp_path / "kept"
    for path in (folder / "000000.safetensors", folder / name):
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text("{}")
    before = sorted(tmp_path.rglob("*"))
    with pytest.raises(FileExistsError, match=rf"kept: expected a new folder.* found {Path(name).parts[0]}$"):
        checkpoint.Unfinished.opened(folder, {"format": checkpoint.FORMAT})
    assert sorted(tmp_path.rglob("*")) == before


def test_of_a_run_with_other_settings_its_own_files_are_removed_and_no_others(tmp_path):
    wanted = {"format": checkpoint.FORMAT, "weights": "a"}
    checkpoint.Unfinished.opened(tmp_path, wanted)
    own = ("000050.safetensors", "1000000.safetensors", f".settings.json.{32 * '0'}.tmp")
    others = ("2024.safetensors", "000050.safetensors.bak", ".mine.tmp")
    for name in (*own, *others):
        (tmp_path / name).write_text("")
    with pytest.warns(DataWarning, match="found another weights"):
        checkpoint.Unfinished.opened(tmp_path, {**wanted, "weights": "b"})
    assert {path.name for path in tmp_path.iterdir()} == {*others, "settings.json"}
    checkpoint.remove(tmp_path)
    assert {path.name for path in tmp_path.iterdir()} == set(others)


@pytest.mark.slow
def test_registration_stops_between_loops_and_goes_on(twice, params, tmp_path, monkeypatch):
    recording, odometry = twice
    done, asked = [], []

    def registered(query, match, *, initial, initial_covariance):
        done.append(None)
        return Registration(initial, np.eye(6), 0.9)

    monkeypatch.setattr(acceptance, "register", registered)
    monkeypatch.setattr(search, "check_installed", lambda: None)
    options = {"odometry": odometry, "config": CONFIG, "registered": True, "kept_in": tmp_path / "kept"}
    stopped = find_loops(recording, params, **options, should_stop=lambda: len(done) >= 2)
    overlaps = [loop.overlap for loop in stopped.loops]
    assert overlaps == [0.9] * 2 + [None] * (len(overlaps) - 2) and len(overlaps) >= 8
    assert stopped.frames == 24 and not stopped.whole and stopped.sessions[0].unregistered == len(overlaps) - 2
    assert str(stopped).endswith(f", {len(overlaps) - 2} not registered")
    read = with_points(recording, lambda path: asked.append(path) or recording.read(path, None, False).points)
    found = find_loops(read, params, **options)
    assert found.whole and all(loop.overlap == 0.9 for loop in found.loops)
    assert len(asked) == 2 * len(found.loops)  # for their registration: no scan was looked at again


def test_frames_come_back_as_they_were_kept(tmp_path):
    keep(tmp_path, WANTED)
    found, kept = recalled(tmp_path, WANTED), fake_frames()
    assert [seen is None for seen, _ in found] == [False, True, False, False, False]
    for one, other in zip(found[4][0], kept[4][0] or (), strict=True):
        np.testing.assert_array_equal(one, other)
    assert found[0][1].link is None
    np.testing.assert_allclose(np.array(found[3][1].link), np.array(kept[3][1].link))
    for (_, one), (_, other) in zip(found, kept, strict=True):
        np.testing.assert_array_equal(one.fits.frames, other.fits.frames)
        np.testing.assert_array_equal(np.stack(one.fits.peaks), np.stack(other.fits.peaks))


def test_a_file_of_another_recording_or_of_other_frames_is_not_believed(tmp_path):
    path = keep(tmp_path / "ours", WANTED)
    other = keep(tmp_path / "theirs", {**WANTED, "recording": "b"}, seed=1)
    ours = path.read_bytes()
    path.write_bytes(other.read_bytes())
    assert recalled(tmp_path / "ours", WANTED) == []
    path.write_bytes(ours)
    path.with_name("000005.safetensors").write_bytes(ours)
    assert len(recalled(tmp_path / "ours", WANTED)) == 5, "the second file has the frames of the first"


@pytest.mark.parametrize(
    "change",
    [
        {"shown": np.array([0, 2, 3, 9])},
        {"images": np.zeros((3, 6, 6), np.uint8)},
        {"counts": np.array([0, 0, 0, 0, 1])},
        {"counts": np.array([0, 0, 0, 3, -1])},
        {"fitted": np.array([1, 4])},
        {"fits": np.full((2, 5), np.nan)},
        {"links": np.array([[np.nan, 0, 0, 0, 0, 0]] * 5)},
        {"made_from": np.zeros(31, np.uint8)},
        {"links": None},
    ],
)
def test_content_that_cannot_be_is_not_believed_though_the_checksum_is_right(tmp_path, change):
    path = keep(tmp_path, WANTED)
    frames, more = Index.load_with(path)
    changed = {name: values for name, values in (more | change).items() if values is not None}
    path.write_bytes(frames.to_bytes(changed))
    assert recalled(tmp_path, WANTED) == []


def test_scans_of_another_drive_have_other_settings_though_sizes_and_times_agree(twice, params, tmp_path):
    finder, paths = sglpr_jax.LoopDetector(params).finder, tuple(tmp_path / f"{name}.bin" for name in twice[0].ids)
    recording = dataclasses.replace(twice[0], paths=paths)
    found = []
    for content in (b"aaaa", b"bbbb"):
        for path in paths:
            path.write_bytes(content)
            os.utime(path, (1e9, 1e9))
        found.append(checkpoint.settings(recording, finder))
    assert found[0]["recording"] == found[1]["recording"] and found[0] != found[1]
    assert checkpoint.settings(dataclasses.replace(recording, name="other"), finder) != found[1]


def test_settings_tell_all_that_changes_what_is_seen(twice, params):
    recording, odometry = twice
    finder = sglpr_jax.LoopDetector(params, config=CONFIG).finder
    base = checkpoint.settings(recording, finder, odometry=odometry)
    tilted = dataclasses.replace(recording, mounting=Mounting(2.0))
    others = (
        checkpoint.settings(tilted, finder, odometry=odometry),
        checkpoint.settings(recording, finder, odometry=odometry + 1e-9),
        checkpoint.settings(recording, finder, odometry=None),
        checkpoint.settings(recording, sglpr_jax.LoopDetector(params).finder, odometry=odometry),
        checkpoint.settings(dataclasses.replace(recording, times=recording.times + 1), finder, odometry=odometry),
    )
    assert base == checkpoint.settings(recording, finder, odometry=odometry.copy())
    assert all(other != base for other in others)
