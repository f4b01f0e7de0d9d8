"""A stream of scans: its loops are true, their poses right; what cannot be handed in is refused."""

import dataclasses

import numpy as np
import pytest

import sglpr_jax
from sglpr_jax.data.recording import Record
from sglpr_jax.loops.acceptance import LITTLE_OVERLAP
from sglpr_jax.loops.candidates import CandidateFinder, Compared
from sglpr_jax.loops.closure import UNKNOWN_HEIGHT_M
from sglpr_jax.loops.comparison import NO_FITS
from sglpr_jax.loops.config import CandidateConfig, DetectorConfig
from sglpr_jax.loops.detector import LoopDetector
from sglpr_jax.loops.keyframes import Seen, square_image
from sglpr_jax.loops.probability import AdditiveModel, Curve, LoopModel
from sglpr_jax.loops.search import find_loops
from sglpr_jax.registration.bev_spectra import within_reach
from sglpr_jax.registration.config import VerificationConfig
from sglpr_jax.se3 import inverse, transform, yaw_of

NOW = DetectorConfig(candidates=CandidateConfig(recent_m=1e-9), keyframe_m=0.0)


@pytest.fixture(scope="module")
def streamed(drive, described, params):
    """The detector after the whole drive, with odometry, and what it returned frame by frame."""
    frames, detector = (
        zip(described, drive.times.tolist(), drive.poses.world_from_lidar, strict=True),
        LoopDetector(params),
    )
    returned = [detector.add_seen(seen, time=time, odometry=pose) for seen, time, pose in frames]
    return detector, returned


def apart(drive, loop) -> float:
    return float(np.linalg.norm(drive.positions[loop.query] - drive.positions[loop.match]))


@pytest.mark.slow
def test_the_loops_of_a_drive_are_true_and_nearly_all(drive, streamed):
    detector, returned = streamed
    loops = [loop for frame in returned for loop in frame]
    assert loops == detector.loops and len({loop.query for loop in loops}) == len(loops)
    assert max(apart(drive, loop) for loop in loops) < np.sqrt(2) * VerificationConfig().max_shift_m
    old = drive.times[:, None] - drive.times[None] >= 30
    near = np.linalg.norm(drive.positions[:, None] - drive.positions[None], axis=2) < 5
    revisits = set(np.flatnonzero((near & old).any(axis=1)).tolist())
    assert len(revisits) > 30 and len(revisits & {loop.query for loop in loops}) >= 0.8 * len(revisits)
    for frame, found in enumerate(returned):
        assert all(frame - 30 <= loop.query <= frame and loop.match < loop.query for loop in found)


@pytest.mark.slow
def test_poses_of_the_loops_are_those_of_the_drive(drive, streamed):
    poses = drive.poses.world_from_lidar
    errors = []
    for loop in streamed[0].loops:
        error = inverse(inverse(poses[loop.match]) @ poses[loop.query]) @ loop.match_from_query
        errors.append((np.linalg.norm(error[:2, 3]), np.degrees(abs(yaw_of(error)))))
        assert loop.probability >= 0.99 and (np.linalg.eigvalsh(loop.covariance) > 0).all()
    metres, degrees = np.median(errors, axis=0)
    assert metres < 0.25 and degrees < 0.3


@pytest.mark.slow
def test_a_whole_recording_is_searched_registered_and_stopped(drive, params, streamed):
    poses = drive.poses.world_from_lidar
    done = []
    found = find_loops(drive, params, odometry=poses, registered=True, on_progress=done.append)
    assert done == list(range(1, len(drive) + 1)) and found.sessions[0].frames == len(drive)
    assert len(found.loops) + len(found.rejected) == sum(
        map(len, (streamed[0].loops, streamed[0].rejected, streamed[0].undecided()))
    )
    assert str(found).startswith(f"{len(found.loops)} loops in 240 of 240 frames of 08")
    for loop in found.loops:
        error = inverse(inverse(poses[loop.match]) @ poses[loop.query]) @ loop.match_from_query
        assert loop.overlap >= LITTLE_OVERLAP and np.linalg.norm(error[:3, 3]) < 0.5
    stopped = find_loops(drive, params, should_stop=lambda: True)
    assert stopped.sessions[0].frames == 0 and stopped.loops == ()


def test_images_and_scans_are_the_same_to_it(drive, params, revisit):
    points = drive.points(revisit[1])
    scans, images = CandidateFinder(params, NOW), CandidateFinder(params, NOW)
    for cloud in (points, drive.points(revisit[0])):
        found = scans.add_seen(scans.seen(Record(points=cloud)))
        same = images.add_seen(images.seen(Record(image=sglpr_jax.density_bev(cloud))))
    assert (found[0].query, found[0].match) == (1, 0)
    for one, other in zip(found[0].alignment, same[0].alignment, strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-5)
    assert found[0].alignment.correlation > 0.4
    image = square_image(Record(points=points))
    np.testing.assert_array_equal(scans.stored.image(0), within_reach(image))
    assert image.shape == (152, 152)


def test_odometry_that_is_far_off_contradicts_a_match(drive, params, revisit):
    query, match = (drive.points(frame) for frame in revisit)
    true = inverse(drive.poses.world_from_lidar[revisit[1]]) @ drive.poses.world_from_lidar[revisit[0]]
    for metres, allowed in ((0.0, True), (12.0, False)):
        finder = CandidateFinder(params, NOW)
        finder.add_seen(finder.seen(Record(points=match)), odometry=np.eye(4))
        (found,) = finder.add_seen(finder.seen(Record(points=query)), odometry=transform(metres, 0.0, 0.0) @ true)
        assert (found.evidence.deviation <= finder.drift.max_deviation) == allowed


@pytest.mark.parametrize(("metres", "there"), [(0.4, 0), (0.6, 1)])
def test_scans_of_one_pass_are_no_candidates(drive, params, revisit, metres, there):
    """The sensor drives that share of `recent_m` away from a place, and back."""
    finder, points = CandidateFinder(params), drive.points(revisit[0])
    for x in (0.0, metres * finder.config.recent_m, 0.0):
        found = finder.add_seen(finder.seen(Record(points=points)), odometry=transform(x, 0.0, 0.0))
    assert len(found) == there


def model_of(log_odds: float) -> LoopModel:
    """A model that says the same of every pair without neighbours."""
    return LoopModel(AdditiveModel({"deviation": Curve((0.0, 1.0), (0.0, 0.0))}, log_odds), "by hand")


THERE_AND_BACK = np.stack(
    [transform(5.0 * frame, 0.0, 0.0) for frame in range(12)]
    + [transform(55.0 - 5.0 * frame, 1.0, np.pi) for frame in range(12)]
)


@pytest.fixture
def streamed_pairs(params, compare_only):
    """`streamed_pairs({query: match}, log_odds, poses)`: the detector after a drive with the true poses of these pairs,
    or with poses that are 5 m off. Without poses of the odometry, the motion is unknown."""

    def streamed(matches, log_odds: float, poses=THERE_AND_BACK, *, wrong=()) -> LoopDetector:
        detector = LoopDetector(params, model=model_of(log_odds))
        seen = Seen(np.zeros(detector.finder.index.width, np.float32), np.ones((152, 152), np.uint8), None)
        off = {query: transform(5.0 * (query in wrong), 0.0, 0.0) for query in matches}
        true = {q: inverse(THERE_AND_BACK[m]) @ THERE_AND_BACK[q] @ off[q] for q, m in matches.items()}
        compare_only({query: (match, true[query]) for query, match in matches.items()})
        for frame in range(len(THERE_AND_BACK)):
            pose = None if poses is None else poses[frame]
            detector.add_seen(seen, odometry=pose, compared=Compared(NO_FITS, None))
        return detector

    return streamed


def pairs(some) -> list[tuple[int, int]]:
    return [(loop.query, loop.match) for loop in some]


def test_a_probable_pair_is_a_loop_and_neighbours_make_less_probable_pairs_loops(streamed_pairs):
    assert pairs(streamed_pairs({18: 5}, 5.0).loops) == [(18, 5)]
    alone, two = streamed_pairs({18: 5}, 4.2), streamed_pairs({18: 5, 19: 4}, 4.2)
    assert pairs(alone.loops) == [] and [one.reason for one in alone.undecided()] == ["too few neighbours"]
    assert pairs(two.loops) == [(18, 5), (19, 4)] and all(loop.probability > 0.99 for loop in two.loops)
    assert not streamed_pairs({18: 5, 19: 4}, 2.0).loops


def test_a_pair_that_is_not_returned_is_rejected_once_its_neighbours_are_known(streamed_pairs):
    detector = streamed_pairs({13: 10, 22: 1}, 0.1)
    assert [(one.loop.query, one.reason) for one in detector.rejected] == []
    assert [(one.loop.query, one.reason) for one in detector.undecided()] == [
        (13, "too few neighbours"),
        (22, "too few neighbours"),
    ]


def test_pairs_that_the_odometry_excludes_are_rejected_with_that_reason(streamed_pairs):
    detector = streamed_pairs({18: 5, 19: 4}, 9.0, wrong=(18,))
    assert pairs(detector.loops) == [(19, 4)]
    assert [(one.loop.query, one.reason) for one in detector.rejected] == [(18, "contradicts the odometry")]


def test_the_height_of_a_loop_is_unknown_unless_the_odometry_measures_it(streamed_pairs):
    climbing = THERE_AND_BACK.copy()
    climbing[1:, 2, 3] = 0.1
    (measured,), (flat,), (without,) = (
        streamed_pairs({18: 5}, 9.0, poses).loops for poses in (climbing, THERE_AND_BACK, None)
    )
    for loop in (flat, without):
        expected = measured.covariance + np.diag([0, 0, UNKNOWN_HEIGHT_M**2, 0, 0, 0])
        np.testing.assert_allclose(loop.covariance, expected, atol=1e-9)


def test_scans_without_points_or_with_one_close_no_loops(params):
    detector = LoopDetector(params, config=DetectorConfig(candidates=NOW.candidates))
    for cloud in (np.zeros((0, 3)), np.array([[5.0, 3, 1]]), np.full((4, 3), np.nan)) * 3:
        assert detector.add(cloud) == []
    assert len(detector) == 9 and not detector.candidates


def test_what_does_not_fit_is_one_clear_error(drive, params, random_params):
    detector = LoopDetector(params)
    cloud = drive.points(0)
    detector.add(cloud, time=5.0)
    for scan, given, message in (
        (cloud, {}, "expected a time for every frame or for none"),
        (cloud, {"time": 4.0}, "times that do not decrease, found 4.0 after 5.0"),
        (cloud, {"time": 6.0, "odometry": np.eye(4)}, "expected odometry for every frame or for none"),
        (cloud, {"time": 6.0, "odometry": 2 * np.eye(4)}, "4 x 4 pose with a rotation"),
        (cloud, {"time": 6.0, "odometry": np.diag([1.0, 1, 1, np.nan])}, "4 x 4 pose with a rotation"),
        (np.zeros(7), {"time": 6.0}, r"points \(n, 3\) or an image"),
        (np.zeros((900, 4)), {"time": 6.0}, r"points \(n, 3\) of x, y and z only, found an array of shape \(900, 4\)"),
    ):
        with pytest.raises(ValueError, match=message):
            detector.add(scan, **given)
    assert len(detector) == 1
    with pytest.raises(ValueError, match="expected odometry of 240 poses, one for each scan of 08, found 3"):
        find_loops(drive, params, odometry=np.stack([np.eye(4)] * 3))
    head = dataclasses.replace(params.config.head, input="counts+labels")
    reads = dataclasses.replace(params.config, categories=20, head=head)
    with pytest.raises(ValueError, match="describes images alone"):
        CandidateFinder(dataclasses.replace(params, config=reads))


FRAMES, SECONDS = 40, np.arange(40.0) / 5
DATES = np.datetime64("2026-01-02T03:04:05", "ns") + (SECONDS * 1e9).astype("timedelta64[ns]")


@pytest.mark.parametrize("times", [1e6 * SECONDS, DATES, np.zeros(FRAMES), None], ids=["us", "dates", "0", "none"])
def test_times_in_any_unit_give_the_same_loops(params, compare_only, times):
    """A circle of 60 m that is driven around twice."""
    angles = 2 * np.pi * np.arange(FRAMES) / (FRAMES // 2)
    poses = [transform(30 * np.cos(a) / np.pi, 30 * np.sin(a) / np.pi, a) for a in angles]
    expected = {query: query - FRAMES // 2 for query in range(FRAMES // 2, FRAMES)}
    compare_only({query: (match, np.eye(4)) for query, match in expected.items()})
    detector = LoopDetector(params)
    for i, pose in enumerate(poses):
        detector.add(np.eye(152), time=None if times is None else times[i], odometry=pose)
    assert {loop.query: loop.match for loop in detector.loops} == expected
