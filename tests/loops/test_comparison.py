"""A query is compared with its match and with places that cannot be it, on drives of a few scans made by hand."""

from collections.abc import Sequence

import numpy as np
import pytest
from scenes import place, seen_from

from sglpr_jax.loops.comparison import Candidate, KeyframeComparison, Query
from sglpr_jax.loops.keyframes import StoredScans
from sglpr_jax.odometry.bev_odometry import BevOdometry
from sglpr_jax.odometry.drift_model import DriftModel
from sglpr_jax.retrieval.index import Index
from sglpr_jax.se3 import transform

EXACT = DriftModel(metres_per_metre=1e-3, degrees_per_metre=1e-4, height_per_metre=0.0)
THERE = (1.2, -0.8, 2.5)
"""Pose of the query at its place."""
PLACES, TRUE, LAST = 10, 2, (1.2 + 60.0 * 2, -0.8, 2.5)


def image(seed: int, pose: tuple[float, float, float] = (0.0, 0.0, 0.0), *, noise: int = 0) -> np.ndarray:
    return seen_from(place(seed), pose, seed=noise).astype(np.uint8)


def street(**more: tuple[float, np.ndarray]) -> tuple[list[np.ndarray], list[np.ndarray]]:
    """Poses and images of places 60 m apart on a line, and of further places at x = `more`."""
    scans = [(60.0 * k, image(k)) for k in range(PLACES)] + list(more.values())
    poses, images = zip(*sorted(scans, key=lambda one: one[0]), strict=True)
    return [transform(x, 0.0, 0.0) for x in poses], list(images)


def compared(
    poses: Sequence[np.ndarray],
    images: Sequence[np.ndarray],
    *,
    joined: Sequence[tuple[int, int]] = (),
    shown: np.ndarray | None = None,
) -> list[Candidate]:
    """Candidates of an image, by default of place `TRUE`. The last pose is that of the image, the others are stored."""
    comparer, stored = comparer_along(poses, joined=joined), StoredScans(Index.empty(2))
    for frame, one in enumerate(images):
        stored.add(frame, np.ones(2, np.float32), one)
    shown = image(TRUE, THERE, noise=1) if shown is None else shown
    query = Query(len(images), np.ones(2, np.float32), shown)
    return comparer.candidates(query, comparer.compare(query, stored), stored)


def comparer_along(poses: Sequence[np.ndarray], *, drift: DriftModel = EXACT, joined=()) -> KeyframeComparison:
    joined = np.array(joined, np.int64).reshape(-1, 2)
    motion = BevOdometry.of(np.stack(poses))
    return KeyframeComparison(motion, drift, loops=joined)


def test_the_place_is_found_and_no_other_place_fits_as_well():
    poses, images = street()
    (found,) = compared([*poses, transform(*LAST)], images)
    assert (found.query, found.match) == (PLACES, TRUE)
    turned = (np.array(found.alignment[:3]) - THERE + np.pi) % (2 * np.pi) - np.pi
    np.testing.assert_allclose(turned, 0, atol=0.2)
    assert found.evidence.deviation < 1 and found.evidence.ambiguity_ratio < 0.7 and found.evidence.surprise > 3


@pytest.mark.parametrize("x", [60.0 * 7 + 20, 60.0 * 2 + 12], ids=["elsewhere", "near, but not so near"])
def test_a_lookalike_whose_fit_the_motion_excludes_makes_a_match_ambiguous(x):
    poses, images = street(lookalike=(x, image(TRUE)))
    (found,) = compared([*poses, transform(*LAST)], images)
    assert found.match == TRUE and found.evidence.ambiguity_ratio > 0.9


def test_the_best_fit_of_another_place_is_told_and_of_no_other_place_nothing():
    poses, images = street()
    elsewhere = image(TRUE, THERE, noise=1)
    for shown, least, most in ((image(99), 0.0, 0.5), (elsewhere, 0.5, 1.0)):
        stored = StoredScans(Index.empty(2))
        for frame, one in enumerate(images):
            stored.add(frame, np.ones(2, np.float32), one)
        at_new_place = [*poses, transform(60.0 * PLACES, 0.0, 0.0)]
        query = Query(len(images), np.ones(2, np.float32), shown)
        assert least < comparer_along(at_new_place).compare(query, stored).lookalike < most
    alone = comparer_along(poses[:1]).compare(Query(0, np.ones(2, np.float32), images[0]), StoredScans(Index.empty(2)))
    assert np.isnan(alone.lookalike)


def test_a_near_scan_that_shows_the_same_place_is_no_lookalike():
    poses, images = street(further=(60.0 * 2 + 11, image(TRUE, (11.0, 0.0, 0.0))))
    (found,) = compared([*poses, transform(*LAST)], images)
    assert found.match == TRUE and found.evidence.ambiguity_ratio < 0.7


def test_a_scan_that_fits_better_where_the_motion_excludes_it_is_a_second_candidate():
    poses, images = street(copy=(60.0 * 7 + 20, image(TRUE, THERE, noise=1)))
    first, second = compared([*poses, transform(*LAST)], images)
    assert (first.match, second.match) == (TRUE, 8)
    assert first.evidence.deviation < EXACT.max_deviation < second.evidence.deviation
    assert first.evidence.ambiguity_ratio > 1 > second.evidence.ambiguity_ratio


@pytest.mark.parametrize("lookalike", [False, True])
def test_one_other_place_shows_that_places_repeat(lookalike):
    poses = [transform(x, 0.0, 0.0) for x in (60.0 * TRUE, 60.0 * 6)]
    (found,) = compared([*poses, transform(*LAST)], [image(TRUE), image(TRUE if lookalike else 3)])
    assert (found.evidence.ambiguity_ratio > 0.9) == lookalike


def test_a_second_pose_that_fits_as_well_makes_a_match_ambiguous():
    """The query stands in the middle of a place that looks the same after a rotation by 180 degrees."""
    points = place(TRUE)
    twice = np.concatenate([points, -points])
    one, turned = (seen_from(twice, pose, seed=1).astype(np.uint8) for pose in ((0.0, 0.0, 0.0), (0.5, 0.0, 0.0)))
    poses = [transform(x, 0.0, 0.0) for x in (0.0, 60.0, 0.5)]
    (found,) = compared(poses, [one, image(3)], shown=turned)
    assert found.evidence.ambiguity_ratio > 0.9


def test_passes_that_a_loop_joins_do_not_compete():
    """The second pass is 5.5 m off: more than the drift between the passes, and less than the drift up to the query."""
    poses, images = street()
    poses += [transform(125.5, 0.0, 0.0), transform(540.0, 0.0, 0.0), transform(125.5 + 1.2, -0.8, 2.5)]
    images += [image(TRUE), image(9)]
    (alone,), (joined,) = (compared(poses, images, joined=loops) for loops in ((), [(PLACES, TRUE)]))
    assert alone.match == joined.match in (TRUE, PLACES)
    assert alone.evidence.ambiguity_ratio > 0.9 > 0.7 > joined.evidence.ambiguity_ratio


def test_elsewhere_is_farther_than_a_shift_and_the_drift():
    poses = [transform(float(x), 0.0, 0.0) for x in range(0, 200, 2)]
    drift = DriftModel(metres_per_metre=0.05, degrees_per_metre=0.0, sideways=0.0)
    found = comparer_along(poses, drift=drift).are_elsewhere(np.arange(100), 50)
    apart = np.abs(np.arange(100) - 50) * 2.0
    np.testing.assert_array_equal(found, apart > np.sqrt(2) * 12 + 4 * 0.05 * apart)
    unknown = comparer_along(poses)
    unknown.motion.add(0.0, continues=False)
    assert not unknown.are_elsewhere(np.arange(100), 100).any()


def test_a_surprise_falls_with_the_poses_that_the_motion_allows():
    poses = [transform(2.0 * k, 0.0, 0.0) for k in range(50)]

    def surprise(position_m: float, yaw_deg: float) -> float:
        rates = {"metres_per_metre": 0.0, "degrees_per_metre": 0.0}
        return comparer_along(poses, drift=DriftModel(**rates, position_m=position_m, yaw_deg=yaw_deg)).surprise(49, 0)

    assert surprise(0.5, 1.5) - surprise(1.0, 1.5) == pytest.approx(np.log(4))
    assert surprise(0.5, 1.5) == surprise(0.5, 3.0)  # the rotation is one of four
    assert surprise(0.5, 1.5) - surprise(0.5, 180 / 8) == pytest.approx(np.log(2))
    unknown = comparer_along(poses)
    unknown.motion.add(0.0, continues=False)
    assert unknown.surprise(50, 0) < -4
