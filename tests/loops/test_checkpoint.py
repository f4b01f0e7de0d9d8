"""A search that was stopped anywhere goes on and ends like one that was not; scans that cannot be read are left out."""

import dataclasses
import functools
import itertools
import os
from pathlib import Path

import numpy as np
import pytest
from recordings import with_points

import sglpr_jax
from sglpr_jax.data.mounting import Mounting
from sglpr_jax.data.scan_stream import only
from sglpr_jax.files import DataWarning
from sglpr_jax.loops import acceptance, checkpoint, search
from sglpr_jax.loops.comparison import NO_FITS, Fits
from sglpr_jax.loops.config import CandidateConfig, DetectorConfig
from sglpr_jax.loops.keyframes import Keyframe
from sglpr_jax.loops.probability import AdditiveModel, Curve, LoopModel
from sglpr_jax.odometry.drift_check import OdometryCheck
from sglpr_jax.pose_graph.folder import write_loop_folder
from sglpr_jax.registration.bev_alignment import BevRegistration
from sglpr_jax.registration.bev_search import CorrelationPeak
from sglpr_jax.registration.gicp import Registration

ROWS = (*range(0, 24, 2), *range(1, 24, 2))
"""A drive that is driven twice."""
ALWAYS = LoopModel(AdditiveModel({"deviation": Curve((0.0,), (0.0,))}, 10.0), "everything")
find_loops = functools.partial(search.find_loops, model=ALWAYS)
"""Every candidate is probable, so that the loops depend on nothing but what is kept."""
CONFIG = DetectorConfig(candidates=CandidateConfig(recent_m=20.0))
DRAW = np.random.default_rng(0)
FITS = Fits(np.array([1, 4]), CorrelationPeak(*DRAW.normal(size=(5, 2))))
SEEN = Keyframe(np.ones(4, np.float32), np.ones((6, 6), np.uint8), Mounting(1.5))
ABOUT = {"name": str, "wall": float}


@pytest.fixture(scope="module")
def twice(drive):
    """The recording, and its odometry."""
    parts = {name: tuple(getattr(drive, name)[i] for i in ROWS) for name in ("ids", "paths")}
    recording = dataclasses.replace(
        drive, **parts, label_paths=(), positions=drive.positions[list(ROWS)], times=np.arange(24.0) / 10
    )
    clouds = {path: drive.points(drive.paths.index(path)) for path in parts["paths"]}
    return with_points(recording, clouds.__getitem__), drive.poses.world_from_lidar[list(ROWS)]


@pytest.fixture(scope="module")
def whole(twice, params, tmp_path_factory):
    """What a run finds that is not stopped, and its files."""
    found = find_loops(twice[0], params, odometry=twice[1], config=CONFIG)
    return found, contents(found, tmp_path_factory.mktemp("whole"))


def contents(found, folder) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in write_loop_folder(found, folder)}


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
    checkpoint.delete_checkpoint(tmp_path / "kept")
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
def test_a_search_without_the_odometry_goes_on_too_and_begins_after_the_last_scan(twice, params, tmp_path, monkeypatch):
    monkeypatch.setattr(OdometryCheck, "errors", (0.5, 0.02))
    recording, scans, done = only(twice[0], range(5)), 5, []
    options = {"odometry": twice[1][:scans], "registered": False, "config": CONFIG, "kept_in": tmp_path / "kept"}
    with pytest.warns(DataWarning, match="contradicts the motion .* and will be ignored after the last scan"):
        (session,) = find_loops(recording, params, **options, should_stop=stopping_after(2, [])).sessions
    assert session.frames == 2 and session.odometry is not None
    for stop in (stopping_after(scans - 2 + 2, []), lambda: False):
        done.clear()
        with pytest.warns(DataWarning, match="contradicts the motion .* and is ignored"):
            found = find_loops(recording, params, **options, should_stop=stop, on_progress=done.append)
        assert found.sessions[0].odometry is None
    assert done[0] == scans and done[1] == 2 and found.whole
    file = tmp_path / "kept" / "of-the-user.bin"
    file.touch()
    checkpoint.delete_checkpoint(tmp_path / "kept")
    assert list((tmp_path / "kept").iterdir()) == [file]
    file.unlink()
    checkpoint.delete_checkpoint(tmp_path / "kept")
    assert not (tmp_path / "kept").exists()


@pytest.mark.slow
def test_a_damaged_frame_alone_is_described_again_and_other_settings_restart(twice, params, whole, tmp_path):
    recording, odometry = twice
    options, log = {"config": CONFIG, "kept_in": tmp_path / "kept"}, tmp_path / "kept" / checkpoint.LOG
    find_loops(recording, params, odometry=odometry, **options, should_stop=stopping_after(16, []))
    content = bytearray(log.read_bytes())
    content[len(content) // 2] ^= 1
    log.write_bytes(content)
    read, done = [], []
    counted = with_points(recording, lambda path: read.append(path) or recording.read(path, None).points)
    for described in (1 + len(ROWS) - 16, 0):
        read.clear()
        found = find_loops(counted, params, odometry=odometry, **options)
        assert len(read) == described + 2 * len(found.loops)  # two for the registration of each
        assert contents(found, tmp_path / "found") == whole[1]
    with pytest.warns(DataWarning, match="the same settings, found another odometry; restarting"):
        find_loops(recording, params, odometry=None, **options, on_progress=done.append)
    assert done[0] == 1
    (tmp_path / "kept" / checkpoint.OLD).touch()
    with pytest.raises(ValueError, match="kept: expected a checkpoint of this version, found that of an earlier one"):
        find_loops(recording, params, **options)


@pytest.mark.slow
def test_scans_that_cannot_be_read_are_left_out_and_frames_keep_their_numbers(twice, params, whole, tmp_path):
    recording, odometry = twice
    broken = {recording.paths[row] for row in (0, 6, 17)}

    def points_of(path):
        if path in broken:
            raise ValueError("expected a whole scan, found half of one")
        return recording.read(path, None).points

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
    broken.clear()  # the checkpoint has the scans after the bad ones as they were compared without them
    assert contents(find_loops(bad, params, **{**options, "on_bad_scan": None}), tmp_path / "found") == whole[1]
    broken |= set(recording.paths)
    with pytest.raises(ValueError, match="expected at least one readable scan, found none"):
        find_loops(bad, params, config=CONFIG, on_bad_scan=lambda scan, error: None)
    for cloud, words in (
        (np.full((1, 3), 5, np.float32), "08: expected at least one scan that is not empty, found 24 empty ones"),
        (np.full((9, 3), np.nan, np.float32), "scan 000000 of sequence 08: expected finite points, found none among 9"),
    ):
        with pytest.raises(ValueError, match=words):
            find_loops(with_points(recording, lambda path, cloud=cloud: cloud), params, config=CONFIG)


@pytest.mark.slow
def test_registration_stops_between_loops_and_goes_on(twice, params, tmp_path, monkeypatch):
    recording, odometry = twice
    done, asked = [], []

    def registered(query, match, *, initial, initial_covariance):
        done.append(None)
        return Registration(initial, np.eye(6), 0.9)

    monkeypatch.setattr(acceptance, "register", registered)
    options = {"odometry": odometry, "config": CONFIG, "registered": True, "kept_in": tmp_path / "kept"}
    stopped = find_loops(recording, params, **options, should_stop=lambda: len(done) >= 2)
    overlaps = [loop.overlap for loop in stopped.loops]
    assert overlaps == [0.9] * 2 + [None] * (len(overlaps) - 2) and len(overlaps) >= 8
    (session,) = stopped.sessions
    assert session.frames == 24 and not stopped.whole and session.unregistered == len(overlaps) - 2
    assert str(stopped).endswith(f", {len(overlaps) - 2} not registered")
    read = with_points(recording, lambda path: asked.append(path) or recording.read(path, None).points)
    found = find_loops(read, params, **options)
    assert found.whole and all(loop.overlap == 0.9 for loop in found.loops)
    assert len(asked) == 2 * len(found.loops)  # for their registration: no scan was looked at again


@pytest.mark.parametrize(("fits", "pose"), [(FITS, np.eye(4)), (NO_FITS, None)])
def test_a_frame_comes_back_from_its_bytes(fits, pose):
    link = BevRegistration(*DRAW.normal(size=3), np.diag([0.3, 0.3, 0.0]) ** 2, 0.8, 0.4) if pose is None else None
    content = checkpoint.frame_bytes(SEEN, fits._replace(link=link), pose=pose, name="a", wall=3.5)
    keyframe, compared, found, about = checkpoint.read_frame(content, 5, ABOUT, source=Path("log"))
    assert keyframe.mounting == SEEN.mounting and about == {"name": "a", "wall": 3.5}
    np.testing.assert_array_equal(keyframe.image, SEEN.image)
    np.testing.assert_array_equal(compared.frames, fits.frames)
    np.testing.assert_array_equal(np.stack(compared.peaks), np.stack(fits.peaks))
    assert (compared.link is None) == (link is None) and (found is None) == (pose is None)
    for one, other in zip(compared.link or (), link or (), strict=True):
        np.testing.assert_array_equal(one, other)


@pytest.mark.parametrize(("cut", "number", "about"), [(0, 4, {}), (9, 5, {}), (0, 5, ABOUT)])
def test_another_content_is_refused(cut, number, about):
    content, bad_scan = (checkpoint.frame_bytes(keyframe, FITS) for keyframe in (SEEN, None))
    assert checkpoint.read_frame(bad_scan, 5, {}, source=Path("log"))[0] is None
    with pytest.raises(ValueError, match=rf"log: expected frame {number}, found another content"):
        checkpoint.read_frame(content[: len(content) - cut], number, about, source=Path("log"))


def test_settings_tell_all_that_changes_what_is_seen(twice, params, tmp_path):
    recording, odometry = twice
    finder = sglpr_jax.LoopDetector(params, config=CONFIG).finder
    paths = tuple(tmp_path / f"{name}.bin" for name in recording.ids)
    files = dataclasses.replace(recording, paths=paths)
    found = []
    for content in (b"aaaa", b"bbbb"):
        for path in paths:
            path.write_bytes(content)
            os.utime(path, (1e9, 1e9))  # sizes and times agree
        found.append(checkpoint.settings(files, finder))
    base = checkpoint.settings(recording, finder, odometry=odometry)
    assert base == checkpoint.settings(recording, finder, odometry=odometry.copy())
    found += [
        base,
        checkpoint.settings(dataclasses.replace(recording, mounting=Mounting(2.0)), finder, odometry=odometry),
        checkpoint.settings(recording, finder, odometry=odometry + 1e-9),
        checkpoint.settings(recording, finder, odometry=None),
        checkpoint.settings(recording, sglpr_jax.LoopDetector(params).finder, odometry=odometry),
        checkpoint.settings(dataclasses.replace(recording, times=recording.times + 1), finder, odometry=odometry),
        checkpoint.settings(dataclasses.replace(recording, name="other"), finder, odometry=odometry),
    ]
    assert all(one != other for one, other in itertools.combinations(found, 2))
