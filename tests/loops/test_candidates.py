"""The candidate search compares each scan with the right earlier scans, estimates the motion, and stores scans."""

import functools

import numpy as np
import pytest
from scenes import place, seen_from

import sglpr_jax
from sglpr_jax.data.mounting import Mounting
from sglpr_jax.data.scan import Scan
from sglpr_jax.grid import Grid
from sglpr_jax.loops.candidates import CandidateSearch
from sglpr_jax.loops.comparison import NO_FITS
from sglpr_jax.loops.config import CandidateConfig, DetectorConfig
from sglpr_jax.loops.keyframes import Keyframe, square_image
from sglpr_jax.registration import background
from sglpr_jax.registration.bev_spectra import within_reach
from sglpr_jax.se3 import inverse, transform

NOW = CandidateConfig(recent_m=1e-9)
CELLS, CELL_M = 152, 0.4
AXIS_M = (np.arange(CELLS) - (CELLS - 1) / 2) * CELL_M
BLANK = np.ones((CELLS, CELLS), np.uint8)


def finder_of(params, candidates: CandidateConfig = CandidateConfig(), **limits) -> CandidateSearch:
    return CandidateSearch(params, DetectorConfig(candidates=candidates, **{"keyframe_m": 0.0, **limits}))


def seen_by(finder: CandidateSearch, image: np.ndarray) -> Keyframe:
    """An image with a descriptor of zeros."""
    return Keyframe(np.zeros(finder.index.width, np.float32), image, None)


@functools.cache
def posts_from(x: float) -> np.ndarray:
    """Image of posts from a position on the x axis."""
    posts = np.random.default_rng(0).uniform(-60, 60, (200, 2))
    apart = np.hypot(AXIS_M[:, None, None] - (posts[:, 0] - x), AXIS_M[None, :, None] - posts[:, 1]).min(axis=-1)
    return np.where(apart < 0.5, 160, 0).astype(np.uint8)


def test_images_and_scans_are_the_same_to_it(drive, params, revisit):
    points = drive.points(revisit[1])
    scans, images = finder_of(params, NOW), finder_of(params, NOW)
    for cloud in (points, drive.points(revisit[0])):
        found = scans.add_keyframe(scans.keyframe(Scan(points=cloud)))
        same = images.add_keyframe(images.keyframe(Scan(image=sglpr_jax.density_bev(cloud))))
    assert (found[0].query, found[0].match) == (1, 0)
    for one, other in zip(found[0].alignment, same[0].alignment, strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-5)
    assert found[0].alignment.correlation > 0.4
    np.testing.assert_array_equal(scans.stored.image(0), within_reach(square_image(Scan(points=points))))


def test_odometry_that_is_far_off_contradicts_a_match(drive, params, revisit):
    query, match = (drive.points(frame) for frame in revisit)
    true = inverse(drive.poses.world_from_lidar[revisit[1]]) @ drive.poses.world_from_lidar[revisit[0]]
    for metres, allowed in ((0.0, True), (12.0, False)):
        finder = finder_of(params, NOW)
        finder.add_keyframe(finder.keyframe(Scan(points=match)), odometry=np.eye(4))
        (found,) = finder.add_keyframe(finder.keyframe(Scan(points=query)), odometry=transform(metres, 0.0, 0.0) @ true)
        assert (found.evidence.deviation <= finder.drift.max_deviation) == allowed


@pytest.mark.parametrize(("share", "there"), [(0.4, 0), (0.6, 1)])
def test_scans_of_one_pass_are_no_candidates(drive, params, revisit, share, there):
    """The sensor drives this share of `recent_m` away from a place, and back."""
    finder = finder_of(params)
    keyframe = finder.keyframe(Scan(points=drive.points(revisit[0])))
    for x in (0.0, share * CandidateConfig().recent_m, 0.0):
        found = finder.add_keyframe(keyframe, odometry=transform(x, 0.0, 0.0))
    assert len(found) == there


PLACES, TRUE = 12, 7


@pytest.fixture(scope="module")
def places() -> list[np.ndarray]:
    """Images of different places, and the image of one of them from another position."""
    poses = [(seed, (0.0, 0.0, 0.0)) for seed in range(PLACES)] + [(TRUE, (1.2, -0.8, 2.5))]
    return [seen_from(place(seed), pose).astype(np.uint8) for seed, pose in poses]


@pytest.mark.parametrize(("further", "found"), [(1, False), (PLACES, True)])
def test_places_with_distant_descriptors_are_found_by_further_comparisons(params, places, further, found):
    config = CandidateConfig(candidates=1, further=further, recent_m=1e-9, cohort=0, near_cohort=0)
    finder = finder_of(params, config)
    descriptors = np.eye(PLACES + 1, finder.index.width, dtype=np.float32)
    for image, descriptor in zip(places[:-1], descriptors, strict=False):
        finder.add_keyframe(Keyframe(descriptor, image, None))
    wrong = (descriptors[0] + 0.1 * descriptors[-1]).astype(np.float32)
    candidates = finder.add_keyframe(Keyframe(wrong / np.linalg.norm(wrong), places[-1], None))
    assert [one.match for one in candidates] == ([TRUE] if found else [])


@pytest.mark.slow
def test_a_good_fit_on_another_floor_does_not_end_the_search(params, places):
    config = CandidateConfig(candidates=1, further=PLACES, recent_m=1e-9, cohort=0, near_cohort=0)
    finder = finder_of(params, config)
    descriptors = np.eye(PLACES, finder.index.width, dtype=np.float32)
    upstairs = [places[TRUE], *places[1:-1]]  # the first place has the same walls as the true one, 8 m higher
    for frame, (image, descriptor) in enumerate(zip(upstairs, descriptors, strict=True)):
        pose = np.eye(4)
        pose[:3, 3] = frame % 3, 0.0, 0.0 if frame else 8.0
        finder.add_keyframe(Keyframe(descriptor, image, None), odometry=pose)
    pose = transform(TRUE % 3 + 1.2, -0.8, 2.5)
    best, *others = finder.add_keyframe(Keyframe(descriptors[0], places[-1], None), odometry=pose)
    assert best.match == TRUE and [one.match for one in others] in ([], [0])


def test_between_plain_walls_the_sensor_moves_on_and_drifts(params):
    """Walls, and posts that end after 10 m, of which an image shows 25 m: from frame 35 on, no post is in reach."""
    finder = finder_of(params)
    rng, grid = np.random.default_rng(0), Grid(resolution_m=CELL_M, height=CELLS, width=CELLS)
    walls = np.stack([rng.uniform(-60, 120, 40_000), np.sign(rng.uniform(-1, 1, 40_000)) * 6.0], axis=1)
    world = np.concatenate([walls, np.repeat(rng.uniform((-60, -5), (10.0, 5), (60, 2)), 20, axis=0)])
    for frame in range(60):
        image = seen_from(world, (float(frame), 0.0, 0.0), grid=grid, seed=frame)
        finder.add_keyframe(seen_by(finder, image.astype(np.uint8)), time=0.1 * frame)
    motion = finder.motion
    assert motion.guessed_m[10] == motion.guessed_m[20] < motion.guessed_m[-1]
    assert (motion.poses[-1] - motion.poses[10])[0, 3] == pytest.approx(49, rel=0.1)
    assert motion.segments[10] == motion.segments[-1]


@pytest.mark.slow
def test_rings_on_the_floor_do_not_hold_the_motion(params, monkeypatch):
    """Without the average of earlier images, only the medians of rings are subtracted."""
    monkeypatch.setattr(background.Background, "add", lambda *_: None)
    finder = finder_of(params)
    radius = np.hypot(AXIS_M[:, None], AXIS_M[None])
    floor = np.where((np.abs(radius[..., None] - (4.0, 6.0, 9.0, 13.0)) < 0.2).any(axis=-1), 80, 0)
    for k in range(20):
        finder.add_keyframe(seen_by(finder, np.maximum(posts_from(k), floor.astype(np.uint8))), time=0.1 * k)
    moved = np.linalg.norm(finder.motion.poses[-1][:3, 3])
    assert moved == pytest.approx(19, abs=1)


def driven(params, step_m: float, turn_deg: float = 0.0, *, frames: int = 41, **limits) -> CandidateSearch:
    """A finder after frames that are `step_m` metres apart, all with one image."""
    finder = finder_of(params, **limits)
    for frame in range(frames):
        pose = transform(step_m * frame, 0.0, np.radians(turn_deg * frame))
        finder.add_keyframe(seen_by(finder, BLANK), odometry=pose, fits=NO_FITS)
    return finder


def test_a_scan_near_the_last_stored_one_is_not_stored_unless_the_sensor_turned(params):
    assert driven(params, 0.25, keyframe_m=10.0).stored.frames.tolist() == list(range(0, 41, 4))
    assert driven(params, 0.0, 2.51, keyframe_m=10.0).stored.frames.tolist() == list(range(0, 41, 4))
    whole = driven(params, 0.25)
    assert whole.stored.frames.tolist() == list(range(41)) and len(whole) == 41


@pytest.mark.parametrize(
    ("lookalike", "step_m", "turn_deg", "apart"),
    [(0.2, 0.5, 0.0, 5), (0.2, 0.0, 5.01, 4), (0.2, 0.5, 7.0, 3), (0.2, 4.0, 0.0, 1), (0.6, 0.25, 0.0, 2)],
)
def test_with_odometry_keyframes_are_some_metres_apart_or_turned(params, lookalike, step_m, turn_deg, apart):
    """They are five times as dense where other places look alike."""
    finder = finder_of(params, keyframe_m=2.5)
    for scan in range(21):
        pose = transform(step_m * scan, 0.0, np.radians(turn_deg * scan))
        if finder.is_due(odometry=pose):
            fits = NO_FITS._replace(lookalike=lookalike)
            finder.add_keyframe(seen_by(finder, BLANK), odometry=pose, fits=fits)
        else:
            finder.skip()
    assert finder.rows.tolist() == list(range(0, 21, apart)) and finder.scans == 21


@pytest.mark.slow
@pytest.mark.parametrize("times", [None, 0.1, 40.0])
def test_without_odometry_keyframes_follow_the_motion_and_a_standing_sensor_is_looked_at_again(params, times):
    """The sensor moves by 1 m a scan, stands for 20 scans, and moves on."""
    finder = finder_of(params, keyframe_m=2.5)
    positions = np.concatenate([np.arange(12.0), np.full(20, 11.0), np.arange(11.0, 24.0)])
    for scan, x in enumerate(positions):
        when = {"time": None if times is None else times * scan}
        if finder.is_due(**when):
            finder.add_keyframe(seen_by(finder, posts_from(x)), **when)
            finder.fits = finder.fits._replace(lookalike=0.2)  # as after a longer drive
        else:
            finder.skip()
    apart = np.diff(finder.rows)
    moving = np.diff(positions[finder.rows]) > 0.5
    assert np.diff(positions[finder.rows]).max() <= 6 and apart[~moving].max() <= 6
    assert np.median(apart[moving]) == 3 and len(finder) < 24
    np.testing.assert_allclose(np.linalg.norm(finder.motion.poses[:, :3, 3], axis=1), positions[finder.rows], atol=0.2)


@pytest.mark.slow
def test_a_sensor_that_stands_at_the_start_is_seen_to_move_off(params):
    finder = finder_of(params, keyframe_m=2.5)
    positions = np.concatenate([np.zeros(90), np.arange(20.0)])
    for x in positions:
        if finder.is_due():
            finder.add_keyframe(seen_by(finder, posts_from(x)))
            finder.fits = finder.fits._replace(lookalike=0.2)
        else:
            finder.skip()
    assert np.diff(positions[finder.rows]).max() <= 4 and not finder.motion.segments.any()


@pytest.mark.slow
def test_flat_odometry_measures_no_height_whatever_the_mountings(params):
    finder = finder_of(params)
    for frame, height_m in enumerate((1.2, 1.25, 1.22)):
        keyframe = seen_by(finder, posts_from(2.0 * frame))._replace(mounting=Mounting(height_m))
        finder.add_keyframe(keyframe, odometry=transform(2.0 * frame, 0.0, 0.0), fits=NO_FITS)
    assert not finder.knows_height
    raised = transform(6.0, 0.0, 0.0)
    raised[2, 3] = 0.1
    finder.add_keyframe(keyframe, odometry=raised, fits=NO_FITS)
    assert finder.knows_height


def test_a_scan_that_cannot_be_read_costs_the_motion_of_its_own_frame_only(params):
    finder = finder_of(params)
    for x in range(12):
        finder.add_keyframe(None if x == 8 else seen_by(finder, posts_from(float(x))))
    assert np.flatnonzero(np.diff(finder.motion.guessed_m)).tolist() == [7]
    np.testing.assert_allclose(np.linalg.norm(finder.motion.poses[:, :3, 3], axis=1), np.arange(12.0), atol=0.2)


def test_after_a_motion_that_is_unknown_a_scan_is_stored(params):
    finder = finder_of(params, keyframe_m=1e9)
    for _ in range(3):  # without links the motion is unknown
        finder.add_keyframe(seen_by(finder, BLANK), fits=NO_FITS)
    assert finder.stored.frames.tolist() == [int(np.flatnonzero(finder.motion.segments == k)[0]) for k in range(3)]


@pytest.mark.slow
def test_memory_stays_bounded(params):
    few, many = (driven(params, 1.0, frames=frames, max_places=32) for frames in (100, 400))
    assert all(len(one.stored) <= 32 for one in (few, many))
    assert few.stored.nbytes == many.stored.nbytes and many.nbytes - few.nbytes < 350 * 512
    assert driven(params, 1.0, frames=400).nbytes > many.nbytes + 600 * 350
