"""Corruptions of clouds against numpy loops, and what must hold for any cloud."""

import math

import hypothesis.extra.numpy as hnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sglpr_jax.bev import rotate_points
from sglpr_jax.data.corruption import (
    CLEAN,
    CORRUPTIONS,
    ROTATION,
    Corruption,
    add_to_range,
    chosen_corruptions,
    corrupt,
    moved_left,
    outside_sector,
)

coordinates = st.one_of(st.just(0.0), st.floats(0.125, 100, width=32), st.floats(-100, -0.125, width=32))
clouds = st.integers(0, 40).flatmap(lambda n: hnp.arrays(np.float32, (n, 3), elements=coordinates))
seeds = st.integers(0, 2**32 - 1)
any_cloud = settings(deadline=None, max_examples=50)


def corrupted(points, kind, strength, seed=0):
    return corrupt(points, Corruption(kind, strength), rng=np.random.default_rng(seed))


def apart(a, b):
    """The angle between two headings, from 0 to pi."""
    return math.acos(max(-1.0, min(1.0, math.cos(a - b))))


@pytest.mark.slow
@any_cloud
@given(clouds, st.floats(-10, 10), st.floats(0, 2 * math.pi))
def test_a_sector_without_points_is_exactly_the_wedge(points, heading, width):
    found = outside_sector(points, heading=heading, width=width)
    for point, outside in zip(points, found, strict=True):
        angle = apart(math.atan2(point[1], point[0]), heading)
        if abs(angle - width / 2) > 1e-5:
            assert outside == (angle > width / 2)


@any_cloud
@given(clouds, seeds)
def test_occlusion_leaves_points_as_they_are_and_draws_a_heading(points, seed):
    left, kept = corrupted(points, "occlusion", 90.0, seed)
    np.testing.assert_array_equal(left, points[kept])
    heading = np.random.default_rng(seed).uniform(-np.pi, np.pi)
    np.testing.assert_array_equal(kept, outside_sector(points, heading=heading, width=np.pi / 2))


def test_an_occlusion_takes_its_share_of_a_full_circle_wherever_it_is():
    angle = np.arange(3600) * (2 * np.pi / 3600)
    circle = np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=1).astype(np.float32)
    kept = np.array([corrupted(circle, "occlusion", 90.0, seed)[1] for seed in range(20)])
    assert np.abs(kept.mean(axis=1) - 0.75).max() < 0.002
    assert not kept.all(axis=0).any(), "the headings cover the circle"


@any_cloud
@given(clouds, seeds, st.floats(0.01, 2))
def test_noise_moves_points_along_their_rays(points, seed, sigma):
    metres = sigma * np.random.default_rng(seed).standard_normal(len(points))
    found, kept = corrupted(points, "noise", sigma, seed)
    assert kept.all()
    for before, after, step in zip(points.astype(float), found.astype(float), metres, strict=True):
        distance = math.hypot(*before)
        expected = before * (distance + step) / distance if distance else before
        np.testing.assert_allclose(after, expected, rtol=1e-5, atol=1e-5)
    np.testing.assert_array_equal(found, add_to_range(points, metres))


def test_noise_has_the_deviation_it_says():
    points = np.random.default_rng(1).normal(scale=20, size=(20000, 3)).astype(np.float32)
    change = np.linalg.norm(corrupted(points, "noise", 0.2)[0], axis=1) - np.linalg.norm(points, axis=1)
    assert change.std() == pytest.approx(0.2, rel=0.03) and abs(change.mean()) < 0.01


@any_cloud
@given(clouds, seeds, st.floats(0, 1))
def test_dropout_keeps_points_in_order(points, seed, share):
    left, kept = corrupted(points, "dropout", share, seed)
    np.testing.assert_array_equal(kept, np.random.default_rng(seed).random(len(points)) >= share)
    np.testing.assert_array_equal(left, points[kept])


def test_dropout_loses_the_share_it_says():
    points = np.ones((20000, 3), np.float32)
    assert corrupted(points, "dropout", 0.9)[1].mean() == pytest.approx(0.1, abs=0.01)


@any_cloud
@given(clouds, st.floats(-5, 5))
def test_an_offset_is_undone_by_its_opposite(points, metres):
    moved = moved_left(points, metres)
    np.testing.assert_allclose(moved, points.astype(float) - [0, metres, 0], atol=1e-5)
    np.testing.assert_allclose(moved_left(moved, -metres), points, atol=1e-4)


def test_an_offset_is_to_either_side():
    ahead = np.float32([[10, 0, 0]])
    sides = {float(corrupted(ahead, "offset", 2.0, seed)[0][0, 1]) for seed in range(20)}
    assert sides == {-2.0, 2.0}


@settings(deadline=None, max_examples=30)
@given(seeds, st.integers(33, 64))
def test_fewer_beams_are_a_half_and_a_quarter_of_the_rings(seed, rings):
    rng = np.random.default_rng(seed)
    elevation = np.radians(np.repeat(np.linspace(-24, 2, rings), 20))
    ray = np.stack([np.cos(elevation), 0 * elevation, np.sin(elevation)], axis=1)
    points = rng.permutation(ray * rng.uniform(3, 60, (len(ray), 1))).astype(np.float32)
    for beams, every in ((32.0, 2), (16.0, 4)):
        left, kept = corrupted(points, "beams", beams)
        np.testing.assert_array_equal(left, points[kept])
        elevation = np.degrees(np.arctan2(left[:, 2], left[:, 0]))
        found = np.unique(np.round((elevation + 24) * (rings - 1) / 26))
        np.testing.assert_array_equal(found, np.arange(0, rings, every))
        assert len(left) == 20 * len(found)


@settings(deadline=None, max_examples=25)
@given(hnp.arrays(np.float32, (9, 3), elements=coordinates), st.floats(-10, 10, width=32))
def test_a_turn_keeps_the_distance_to_the_sensor(points, angle):
    turned = np.asarray(rotate_points(points, np.float32(angle)))
    np.testing.assert_allclose(np.linalg.norm(turned, axis=1), np.linalg.norm(points, axis=1), rtol=1e-5)


@pytest.mark.parametrize("kind", ["clean", "occlusion", "noise", "dropout", "offset"])
@any_cloud
@given(points=clouds, seed=seeds)
def test_no_strength_is_no_corruption(kind, points, seed):
    left, kept = corrupted(points, kind, 0.0, seed)
    np.testing.assert_array_equal(left, points)
    assert kept.all() and left.dtype == np.float32


def test_rotation_is_left_to_embedding():
    with pytest.raises(ValueError, match="rotation_seed"):
        corrupt(np.zeros((1, 3), np.float32), ROTATION, rng=np.random.default_rng(0))


def test_names_say_kind_and_strength():
    names = [corruption.name for corruption in CORRUPTIONS]
    assert len(set(names)) == len(names)
    assert {"rotation", "occlusion-90", "beams-16", "noise-0.05", "dropout-0.9", "offset-2"} < set(names)
    labels = {corruption.name: corruption.label for corruption in (CLEAN, *CORRUPTIONS)}
    expected = {"clean": "clean", "occlusion-90": "90°", "beams-16": "16", "noise-0.05": "0.05 m", "dropout-0.9": "0.9"}
    assert expected.items() <= labels.items()


def test_a_kind_stands_for_all_its_strengths():
    assert chosen_corruptions(()) == CORRUPTIONS
    assert [d.name for d in chosen_corruptions(("beams-16", "rotation", "noise", "noise-0.1"))] == [
        *("rotation", "beams-16", "noise-0.05", "noise-0.1", "noise-0.2")
    ]


@pytest.mark.parametrize(
    ("kind", "strength"),
    [("beams", 0.0), ("dropout", 1.5), ("occlusion", 361.0), ("noise", -0.1), ("offset", float("nan"))],
)
def test_a_strength_that_cannot_be_is_refused(kind, strength):
    with pytest.raises(ValueError, match=f"expected {kind} with a strength from . to .*, found {strength:g}"):
        Corruption(kind, strength)


@pytest.mark.parametrize(("name", "nearest"), [("beams-64", "beams-16"), ("rotatoin", "rotation"), ("noize", "noise")])
def test_an_unknown_name_gets_the_nearest(name, nearest):
    with pytest.raises(
        ValueError, match=f"expected a corruption, found '{name}'; did you mean '{nearest}.*Available: rotation, occ"
    ):
        chosen_corruptions((name,))
