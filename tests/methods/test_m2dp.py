import math

import numpy as np
import pytest

from sglpr_jax.methods.handcrafted.m2dp import m2dp, signature


def signature_in_loops(points):
    """The paper's matrix A from its definition: plane by plane, point by point."""
    centred = points.astype(np.float64) - points.mean(axis=0, dtype=np.float64)
    _, _, axes = np.linalg.svd(centred, full_matrices=False)
    first, second = (axis * (1 if np.sum((centred @ axis) ** 3) >= 0 else -1) for axis in axes[:2])
    cloud = centred @ np.stack([first, second, np.cross(first, second)], axis=1)
    rho = max(np.linalg.norm(cloud, axis=1))
    edges = np.linspace(0, math.sqrt(rho), 9) ** 2
    edges[-1] += 0.001
    rows = []
    for normal in normals():
        x_axis = np.array([1.0, 0, 0]) - normal[0] * normal
        y_axis = np.cross(normal, x_axis)
        counts = np.zeros((8, 16))
        for point in cloud:
            x, y = point @ x_axis, point @ y_axis
            ring = max(k for k in range(8) if math.hypot(x, y) >= edges[k])
            sector = min(int((math.atan2(y, x) + math.pi) / (2 * math.pi) * 16), 15)
            counts[ring, sector] += 1
        rows.append(counts.ravel() / len(cloud))
    return np.array(rows)


def normals():
    """The normal of every plane: 16 elevations of each of 4 azimuths."""
    for azimuth in np.linspace(-math.pi / 2, math.pi / 2, 4):
        for elevation in np.linspace(0, math.pi / 2, 16):
            flat = math.cos(elevation)
            yield np.array([flat * math.cos(azimuth), flat * math.sin(azimuth), math.sin(elevation)])


def first_singular_vectors(a):
    """By power iteration."""
    right = np.ones(128)
    for _ in range(200):
        left = a @ right / np.linalg.norm(a @ right)
        right = a.T @ left / np.linalg.norm(a.T @ left)
    return np.concatenate([left, right])


def points_of(seed):
    return (np.random.default_rng(seed).gamma(2.0, 1.0, (150, 3)) * [9, 4, 1]).astype(np.float32)


@pytest.mark.parametrize("seed", [0, 1])
def test_the_descriptor_is_the_papers(seed):
    points = points_of(seed)
    np.testing.assert_allclose(signature(points), signature_in_loops(points), atol=1e-9)
    np.testing.assert_allclose(m2dp(points), first_singular_vectors(signature_in_loops(points)), atol=1e-4)


def test_both_halves_are_directions_without_negative_numbers(places):
    for points, _ in places:
        found = m2dp(points)
        assert found.dtype == np.float32 and found.min() >= 0
        np.testing.assert_allclose([np.linalg.norm(found[:64]), np.linalg.norm(found[64:])], 1, atol=1e-5)


def test_any_rigid_motion_leaves_it_and_another_place_does_not(places):
    points = places[0][0].astype(np.float64)
    turn, _ = np.linalg.qr(np.random.default_rng(0).normal(size=(3, 3)))
    turn *= np.sign(np.linalg.det(turn))
    moved = (points @ turn.T + [3.0, -5.0, 1.0]).astype(np.float32)
    here = m2dp(places[0][0])
    assert np.linalg.norm(m2dp(moved) - here) < 1e-3
    mirrored = (points * [1, -1, 1]).astype(np.float32)
    assert np.linalg.norm(m2dp(mirrored) - here) > 0.02
    assert np.linalg.norm(m2dp(places[1][0]) - here) > 0.5


@pytest.mark.parametrize("points", [np.zeros((1, 3)), np.ones((5, 3)), np.eye(3)])
def test_clouds_without_extent_have_descriptors_too(points):
    assert np.isfinite(m2dp(points.astype(np.float32))).all()
