"""A stream of scans: its loops are true, their poses right; what cannot be handed in is refused."""

import dataclasses

import numpy as np
import pytest

import sglpr_jax
from sglpr_jax.data.record import Record
from sglpr_jax.loops.candidates import CandidateFinder, Compared
from sglpr_jax.loops.compared_image import within_reach
from sglpr_jax.loops.comparison import Candidate
from sglpr_jax.loops.config import CandidateConfig, DetectorConfig, RivalConfig, SequenceConfig
from sglpr_jax.loops.detector import LoopDetector
from sglpr_jax.loops.find import find_loops
from sglpr_jax.loops.joint import LITTLE_OVERLAP
from sglpr_jax.loops.probability import Curve, Evidence, LoopModel
from sglpr_jax.loops.seen import Seen, square_image
from sglpr_jax.loops.transforms import inverse, transform, yaw_of
from sglpr_jax.loops.verification import Alignment

NOW = CandidateConfig(exclude_frames=0, min_travelled_m=0.0)


@pytest.fixture(scope="module")
def params():
    return sglpr_jax.load("circular")


@pytest.fixture(scope="module")
def streamed(drive, params):
    """The detector after the whole drive, with odometry, and what it returned frame by frame."""
    detector = LoopDetector(params)
    poses = drive.poses.world_from_lidar
    returned = [detector.add(drive.points(i), time=drive.times[i], odometry=poses[i]) for i in range(len(drive))]
    return detector, returned


def apart(drive, loop) -> float:
    return float(np.linalg.norm(drive.positions[loop.query] - drive.positions[loop.match]))


@pytest.mark.slow
def test_the_loops_of_a_drive_are_true_and_nearly_all(drive, streamed):
    detector, returned = streamed
    loops = [loop for frame in returned for loop in frame]
    assert loops == detector.loops and len({loop.query for loop in loops}) == len(loops)
    assert max(apart(drive, loop) for loop in loops) < 12
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
    assert done == list(range(1, len(drive) + 1)) and found.frames == len(drive)
    assert len(found.loops) + len(found.rejected) == len(streamed[0].supported) + len(streamed[0].rejected)
    assert str(found).startswith(f"{len(found.loops)} loops in 240 of 240 frames of 08")
    for loop in found.loops:
        error = inverse(inverse(poses[loop.match]) @ poses[loop.query]) @ loop.match_from_query
        assert loop.overlap >= LITTLE_OVERLAP and np.linalg.norm(error[:3, 3]) < 0.5
    stopped = find_loops(drive, params, should_stop=lambda: True)
    assert stopped.frames == 0 and stopped.loops == ()


def test_images_and_scans_are_the_same_to_it(drive, params, revisit):
    points = drive.points(revisit[1])
    scans, images = CandidateFinder(params, config=NOW), CandidateFinder(params, config=NOW)
    for cloud in (points, drive.points(revisit[0])):
        found = scans.add(Record(points=cloud))
        same = images.add(Record(image=sglpr_jax.density_bev(cloud)))
    assert (found[0].query, found[0].match) == (1, 0)
    for one, other in zip(found[0].alignment, same[0].alignment, strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-5)
    assert found[0].alignment.correlation > 0.4 and np.isnan(found[0].evidence.rival)
    image = square_image(Record(points=points))
    np.testing.assert_array_equal(scans.stored.image(0), within_reach(image))
    assert image.shape == (152, 152)


def test_odometry_far_off_leaves_a_candidate_out(drive, params, revisit):
    query, match = (drive.points(frame) for frame in revisit)
    for metres, there in ((12.0, 1), (90.0, 0)):
        finder = CandidateFinder(params, config=NOW)
        finder.add(Record(points=match), odometry=np.eye(4))
        assert len(finder.add(Record(points=query), odometry=transform(metres, 0.0, 0.0))) == there


def test_a_frame_near_which_the_sensor_stayed_is_no_candidate(drive, params, revisit):
    config = CandidateConfig(exclude_frames=0)
    for metres, there in ((3.0, 0), (12.0, 1)):
        finder = CandidateFinder(params, config=config)
        for step in (0.0, metres, metres):
            found = finder.add(Record(points=drive.points(revisit[0])), odometry=transform(step, 0.0, 0.0))
        assert len(found) == there


def model_of(log_odds: float) -> LoopModel:
    """A model that says the same of every pair."""
    return LoopModel({"distance": Curve((0.0,), (0.0,))}, log_odds, "by hand")


def streamed_pairs(params, matches: dict[int, int], model: LoopModel, **options) -> LoopDetector:
    """The detector after 20 frames 5 m apart, some of which have a match where the query is said to be."""
    detector = LoopDetector(params, model=model, config=DetectorConfig(candidates=NOW, **options))
    seen = Seen(np.zeros(detector.finder.index.width, np.float32), np.ones((152, 152), np.uint8), None)
    poses = [transform(5.0 * frame, 0.0, 0.0) for frame in range(10)]
    poses += [transform(45.0 - 5.0 * frame, 1.0, np.pi) for frame in range(10)]
    for query, pose in enumerate(poses):
        pairs = []
        if query in matches:
            true = inverse(poses[matches[query]]) @ pose
            alignment = Alignment(*true[:2, 3], yaw_of(true), np.diag([0.1, 0.1, 0.01]), 0.8, 0.3)
            pairs = [Candidate(query, matches[query], alignment, Evidence.of(1.0, 0.5, 0.8, 0.3, 0.3, 1e3))]
        detector.add_seen(seen, odometry=pose, compared=Compared(pairs, None))
    return detector


def test_one_probable_frame_is_no_loop_two_that_agree_are(params):
    alone = streamed_pairs(params, {15: 4}, model_of(6.0))
    assert alone.loops == [] and [one.reason for one in alone.rejected] == []
    two = streamed_pairs(params, {12: 7, 13: 6}, model_of(6.0))
    assert [(loop.query, loop.match) for loop in two.loops] == [(12, 7), (13, 6)]
    assert all(loop.probability > 0.999 for loop in two.loops)


def test_neighbours_make_a_less_probable_pair_a_loop(params):
    assert streamed_pairs(params, {12: 7, 13: 6}, model_of(3.5)).loops  # .97 each
    assert not streamed_pairs(params, {12: 7, 13: 6}, model_of(2.0)).loops


def test_pairs_that_other_places_fit_as_well_are_rejected_with_that_reason(params):
    repeats = Curve((0.5, 1.0), (12.0, 0.0))
    model = LoopModel({"distance": Curve((0.0,), (0.0,)), "rival": repeats}, -6.0, "by hand")
    detector = LoopDetector(params, model=model, config=DetectorConfig(candidates=NOW))
    seen = Seen(np.zeros(detector.finder.index.width, np.float32), np.ones((152, 152), np.uint8), None)
    alignment = Alignment(*np.zeros(3), np.eye(3), 0.9, 0.3)
    for rival, reasons in ((1.0, ["repeats"]), (np.nan, ["repeats"] * 2), (0.5, ["repeats"] * 2)):
        pair = Candidate(len(detector), 0, alignment, Evidence.of(0.1, 0.5, 0.9, 0.3, rival, 1e3))
        detector.add_seen(seen, compared=Compared([pair], None))
        assert [one.reason for one in detector.rejected] == reasons


@pytest.mark.parametrize(
    ("config", "name"), [(DetectorConfig, "min_probability"), (SequenceConfig, "least_probability")]
)
@pytest.mark.parametrize("value", [-0.1, 1.01, np.nan])
def test_what_is_no_probability_is_refused(config, name, value):
    with pytest.raises(ValueError, match=f"expected {name} from 0 to 1, found {value}"):
        config(**{name: value})


@pytest.mark.parametrize("config", [CandidateConfig, RivalConfig])
def test_more_comparisons_than_fit_into_memory_are_refused(config):
    name = "candidates" if config is CandidateConfig else "of_query"
    for value in (10**9, -1):
        with pytest.raises(ValueError, match=f"{name}: expected a number from [01] up to 1000, found {value}"):
            config(**{name: value})


def test_scans_without_points_or_with_one_close_no_loops(params):
    detector = LoopDetector(params, config=DetectorConfig(candidates=NOW))
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
