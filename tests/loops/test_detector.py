"""A stream of scans: its loops are true, their poses right; what cannot be handed in is refused."""

import dataclasses

import numpy as np
import pytest

import sglpr_jax
from sglpr_jax.data.record import Record
from sglpr_jax.loops.candidates import Candidate, CandidateConfig, CandidateFinder, Seen, labelled, square_image
from sglpr_jax.loops.detector import DetectorConfig, LoopDetector
from sglpr_jax.loops.drift import DriftModel
from sglpr_jax.loops.find import find_loops
from sglpr_jax.loops.joint import MIN_OVERLAP
from sglpr_jax.loops.probability import Evidence, LoopModel
from sglpr_jax.loops.transforms import inverse, transform, yaw_of
from sglpr_jax.loops.verification import Alignment

NOW = CandidateConfig(exclude_frames=0)


@pytest.fixture(scope="module")
def params():
    return sglpr_jax.load("rings")


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
        assert all(frame - 2 <= loop.query <= frame and loop.match < loop.query for loop in found)


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
        assert loop.overlap >= MIN_OVERLAP and np.linalg.norm(error[:3, 3]) < 0.5
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
    assert found[0].alignment.correlation > 0.4 and np.isnan(found[0].evidence.margin)
    np.testing.assert_array_equal(scans.images[0], square_image(Record(points=points)))
    assert scans.images[0].shape == (152, 152)


def test_odometry_far_off_leaves_a_candidate_out_and_margins_are_of_other_places(drive, params, revisit):
    query, match = (drive.points(frame) for frame in revisit)
    for metres, there in ((5.0, 1), (90.0, 0)):
        finder = CandidateFinder(params, config=NOW)
        finder.add(Record(points=match), odometry=np.eye(4))
        assert len(finder.add(Record(points=query), odometry=transform(metres, 0.0, 0.0))) == there
    finder = CandidateFinder(params, config=NOW, drift=DriftModel(metres_per_metre=0.1))
    for k, cloud in enumerate((match, drive.points(0), query)):
        found = finder.add(Record(points=cloud), odometry=transform((0.0, 21.0, 2.0)[k], 0.0, 0.0))
    distances = np.linalg.norm(finder.index.descriptors[:2] - finder.index.descriptors[2], axis=1)
    assert found[0].match == 0
    assert found[0].evidence.margin == pytest.approx(distances[1] - distances[0], rel=1e-4)


def test_candidates_with_true_positions_are_labelled():
    finder_gave = [_candidate(5, 0), _candidate(6, 1), _candidate(7, 2)]
    positions = np.zeros((8, 3))
    positions[5:, 0] = 3, 15, 40
    evidence, is_loop = labelled(finder_gave, positions)
    assert is_loop.tolist() == [True, False] and evidence.distance.tolist() == [5, 7]


def _candidate(query: int, match: int):
    return Candidate(query, match, None, Evidence(float(query), 0.0, 0.0, 0.0))


def test_one_probable_frame_is_no_loop_two_in_a_row_are(drive, params, revisit):
    """A model that calls everything a loop, so that what counts is the order of frames."""
    always = LoopModel({"distance": 0.0}, {"distance": 0.0}, {"distance": 1.0}, 10.0, "everything")
    config = DetectorConfig(candidates=NOW)
    detector = LoopDetector(params, model=always, config=config)
    places = (revisit[1], revisit[1] + 1, revisit[0] - 1, revisit[0])
    returned = [detector.add(drive.points(frame)) for frame in places]
    assert [len(found) for found in returned[:2]] == [0, 0]
    assert detector.loops and all(loop.probability > 0.99 for loop in detector.loops)


def test_a_least_probability_below_that_of_neighbours_is_theirs_too(params):
    third = LoopModel({"distance": 0.0}, {"distance": 0.0}, {"distance": 1.0}, float(np.log(0.5)), "1 of 3")
    alignment = Alignment(*np.zeros(3), np.eye(3), 0.8, 0.3)
    for least, there in ((0.2, 2), (0.4, 0)):
        config = DetectorConfig(min_probability=least, candidates=NOW)
        detector = LoopDetector(params, model=third, config=config)
        seen = Seen(np.zeros(detector.finder.index.width, np.float32), np.ones((152, 152), np.uint8), None)
        for query in range(4):
            pair = Candidate(query, query - 2, alignment, Evidence.of(1.0, 0.0, 0.8, 0.3))
            detector.add_seen(seen, candidates=[pair] if query >= 2 else [])
        assert len(detector.loops) == there


@pytest.mark.parametrize("name", ["min_probability", "min_neighbour_probability"])
@pytest.mark.parametrize("value", [-0.1, 1.01, np.nan])
def test_what_is_no_probability_is_refused(name, value):
    with pytest.raises(ValueError, match=f"expected {name} from 0 to 1, found {value}"):
        DetectorConfig(**{name: value})


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
        (cloud, {"time": 4.0}, "times that do not go back, found 4.0 after 5.0"),
        (cloud, {"time": 6.0, "odometry": np.eye(4)}, "expected odometry for every frame or for none"),
        (cloud, {"time": 6.0, "odometry": 2 * np.eye(4)}, "4 x 4 pose with a rotation"),
        (cloud, {"time": 6.0, "odometry": np.diag([1.0, 1, 1, np.nan])}, "4 x 4 pose with a rotation"),
        (np.zeros(7), {"time": 6.0}, r"points \(n, 3\) or an image"),
        (np.zeros((900, 4)), {"time": 6.0}, r"x, y and z alone, \(n, 3\), found an array of shape \(900, 4\)"),
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
