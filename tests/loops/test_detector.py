"""A stream of scans: its loops are true, their poses right; what cannot be handed in is refused."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest
from drives import PASS
from recordings import of_scans

from sglpr_jax.loops.acceptance import LITTLE_OVERLAP
from sglpr_jax.loops.candidates import CandidateSearch
from sglpr_jax.loops.closure import UNKNOWN_HEIGHT_M
from sglpr_jax.loops.comparison import NO_FITS
from sglpr_jax.loops.config import CandidateConfig, DetectorConfig
from sglpr_jax.loops.detector import LoopDetector
from sglpr_jax.loops.keyframes import Keyframe
from sglpr_jax.loops.probability import AdditiveModel, Curve, LoopModel
from sglpr_jax.loops.result import LoopSearchResult
from sglpr_jax.loops.search import find_loops
from sglpr_jax.se3 import inverse, transform, yaw_of

NOW = DetectorConfig(candidates=CandidateConfig(recent_m=1e-9), keyframe_m=0.0)


def error_of(poses, loop) -> np.ndarray:
    """Error of a loop, (x, y, z) in metres and yaw in degrees."""
    error = inverse(inverse(poses[loop.match]) @ poses[loop.query]) @ loop.match_from_query
    return np.array([*error[:3, 3], np.degrees(abs(yaw_of(error)))])


@pytest.mark.slow
def test_the_loops_of_a_drive_are_true_and_nearly_all(street, streamed):
    detector, returned = streamed
    loops = [loop for frame in returned for loop in frame]
    assert loops == detector.loops and len({loop.query for loop in loops}) == len(loops) >= 0.8 * PASS
    for frame, found in enumerate(returned):
        assert all(frame - 30 <= loop.query <= frame and loop.match < loop.query for loop in found)
    errors = np.abs([error_of(street.poses.world_from_lidar, loop) for loop in loops])
    assert np.linalg.norm(errors[:, :2], axis=1).max() < 0.5 and np.median(errors[:, 3]) < 0.3
    assert all(loop.probability >= 0.99 and (np.linalg.eigvalsh(loop.covariance) > 0).all() for loop in loops)


@pytest.mark.slow
def test_a_whole_recording_is_searched_registered_and_stopped(street, params, streamed):
    poses, done = street.poses.world_from_lidar, []
    found = find_loops(street, params, odometry=poses, registered=True, on_progress=done.append)
    assert done == list(range(1, len(street) + 1)) and found.sessions[0].frames == len(street)
    detector = streamed[0]
    pairs = detector.loops, detector.rejected, detector.undecided()
    assert len(found.loops) + len(found.rejected) == sum(map(len, pairs))
    assert str(found).startswith(f"{len(found.loops)} loops in 40 of 40 frames of 08")
    for loop in found.loops:
        assert loop.overlap >= LITTLE_OVERLAP and np.linalg.norm(error_of(poses, loop)[:3]) < 0.5
    stopped = find_loops(street, params, should_stop=lambda: True)
    assert stopped.sessions[0].frames == 0 and stopped.loops == ()


@pytest.mark.slow
def test_scans_between_keyframes_are_not_read_and_loops_have_the_numbers_of_scans(street, params, monkeypatch):
    """Every scan is followed by two others at the same place. Loops are checked against the odometry by keyframe."""
    checked = []
    monkeypatch.setattr("sglpr_jax.loops.search.check_odometry", lambda _, agreeing, *__: checked.append(agreeing))
    clouds, poses, reads = [street.points(row) for row in range(len(street))], street.poses.world_from_lidar, []

    def search(times: int) -> LoopSearchResult:
        """Search the drive with each scan repeated this often."""
        paths = [Path(f"{row:06d}.bin") for row in range(times * len(street))]
        plain = of_scans({path: clouds[row // times] for row, path in enumerate(paths)})

        def read(path, labels):
            reads.append(path)
            return plain.read(path, labels)

        odometry = np.repeat(poses, times, axis=0)
        return find_loops(dataclasses.replace(plain, read=read), params, odometry=odometry, registered=False)

    sparse, found = search(1), search(3)
    session = found.sessions[0]
    assert len(reads) == 2 * len(street) and (session.frames, session.keyframes) == (120, 40)
    assert [(loop.query, loop.match) for loop in found.loops] == [(3 * x.query, 3 * x.match) for x in sparse.loops]
    assert [[loop.query for loop in loops] for loops in checked] == [[loop.query for loop in sparse.loops]] * 2
    assert len(found.loops) > 5 and found.whole and "in 120 of 120 frames of 08 (40 keyframes)" in str(found)


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
        keyframe = Keyframe(np.zeros(detector.finder.index.width, np.float32), np.ones((152, 152), np.uint8), None)
        off = {query: transform(5.0 * (query in wrong), 0.0, 0.0) for query in matches}
        true = {q: inverse(THERE_AND_BACK[m]) @ THERE_AND_BACK[q] @ off[q] for q, m in matches.items()}
        compare_only({query: (match, true[query]) for query, match in matches.items()})
        for frame in range(len(THERE_AND_BACK)):
            pose = None if poses is None else poses[frame]
            detector.add_keyframe(keyframe, odometry=pose, fits=NO_FITS)
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


def test_what_does_not_fit_is_one_clear_error(params, random_params):
    detector = LoopDetector(params)
    cloud = np.random.default_rng(0).normal(scale=9, size=(900, 3))
    detector.add(cloud, time=5.0)
    for scan, given, message in (
        (cloud, {}, "expected a time for every frame or for none"),
        (cloud, {"time": 4.0}, "times that do not decrease, found 4.0 after 5.0"),
        (cloud, {"time": 6.0, "odometry": np.eye(4)}, "expected odometry for every frame or for none"),
        (cloud, {"time": 6.0, "odometry": 2 * np.eye(4)}, r"odometry \(4, 4\), with rotations"),
        (np.zeros((900, 4)), {"time": 6.0}, r"points \(n, 3\) of x, y and z only, found an array of shape \(900, 4\)"),
    ):
        with pytest.raises(ValueError, match=message):
            detector.add(scan, **given)
    assert len(detector) == 1
    head = dataclasses.replace(params.config.head, input="counts+labels")
    reads = dataclasses.replace(params.config, categories=20, head=head)
    with pytest.raises(ValueError, match="describes images alone"):
        CandidateSearch(dataclasses.replace(params, config=reads))
