"""Rays against a numpy reference that tries every surface of every shape on its own."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sglpr_jax.sim.shapes import Scene, Shapes, Vectors, nearest_hit

COUNT = 12  # shapes of each kind
RAYS = 300
jitted_nearest_hit = jax.jit(nearest_hit)


def random_shapes(rng: np.random.Generator, count: int = COUNT) -> Shapes:
    bearing, away = rng.uniform(-np.pi, np.pi, count), rng.uniform(6, 60, count)
    centre = np.stack([away * np.cos(bearing), away * np.sin(bearing), rng.uniform(-2, 2, count)], axis=1)
    half = rng.uniform(0.1, 3, (count, 3))
    yaw, label = rng.uniform(-np.pi, np.pi, count), rng.integers(1, 99, count)
    f32 = np.float32
    return Shapes(centre.astype(f32), half.astype(f32), yaw.astype(f32), label, np.zeros(count, f32))


def random_scene(seed: int) -> tuple[Vectors, Scene]:
    """A scene around the origin, and rays, most of them near a shape's centre."""
    rng = np.random.default_rng(seed)
    scene = Scene(*(random_shapes(rng) for _ in range(3)))
    targets = np.concatenate([shapes.centre for shapes in scene])[rng.integers(0, 3 * COUNT, RAYS)]
    directions = targets / np.linalg.norm(targets, axis=1, keepdims=True) + rng.normal(0, 0.05, (RAYS, 3))
    return Vectors(*directions.T.astype(np.float32)), scene


def local(vectors: np.ndarray, shapes: Shapes, i: int) -> np.ndarray:
    """Vectors in the unit frame of shape `i`, in float64."""
    cos, sin = np.cos(np.float64(shapes.yaw[i])), np.sin(np.float64(shapes.yaw[i]))
    rotation = np.array([[cos, sin, 0], [-sin, cos, 0], [0, 0, 1]])
    return vectors @ rotation.T / shapes.half[i]


def first_of(distances: np.ndarray, on_surface: np.ndarray) -> np.ndarray:
    return np.where(on_surface & (distances > 0), distances, np.inf).min(axis=0)


def face_hits(o: np.ndarray, d: np.ndarray, axes: tuple[int, ...]) -> np.ndarray:
    """Distances to the planes at -1 and 1 of each of `axes`: (planes, rays)."""
    return np.stack([(side - o[axis]) / d[:, axis] for axis in axes for side in (-1, 1)])


def quadric_hits(o: np.ndarray, d: np.ndarray) -> np.ndarray:
    """Distances at which |o + t d| = 1: (2, rays), NaN where there are none."""
    a, b, c = (d * d).sum(1), 2 * (d @ o), o @ o - 1
    with np.errstate(invalid="ignore"):
        root = np.sqrt(b * b - 4 * a * c)
    return np.stack([(-b - root) / (2 * a), (-b + root) / (2 * a)])


def box_distance(o: np.ndarray, d: np.ndarray) -> np.ndarray:
    t = face_hits(o, d, (0, 1, 2))
    return first_of(t, np.abs(o + t[..., None] * d).max(-1) <= 1 + 1e-9)


def cylinder_distance(o: np.ndarray, d: np.ndarray) -> np.ndarray:
    mantle, caps = quadric_hits(o[:2], d[:, :2]), face_hits(o, d, (2,))
    on_mantle = np.abs(o[2] + mantle * d[:, 2]) <= 1
    on_cap = np.linalg.norm(o[:2] + caps[..., None] * d[:, :2], axis=-1) <= 1
    return np.minimum(first_of(mantle, on_mantle), first_of(caps, on_cap))


def ellipsoid_distance(o: np.ndarray, d: np.ndarray) -> np.ndarray:
    t = quadric_hits(o, d)
    return first_of(t, np.isfinite(t))


def reference(rays: Vectors, scene: Scene, grow: float = 1.0) -> tuple[np.ndarray, np.ndarray]:
    """Distance and index of the first surface of all, in float64; `grow` scales every shape."""
    directions = np.stack(rays, axis=1).astype(np.float64)
    rows = []
    for shapes, distance in zip(scene, (box_distance, cylinder_distance, ellipsoid_distance), strict=True):
        grown = shapes._replace(half=shapes.half * grow)
        for i in range(len(shapes.label)):
            origin = local(-shapes.centre[i].astype(np.float64), grown, i)
            rows.append(distance(origin, local(directions, grown, i)))
    rows = np.array(rows)
    return rows.min(0), np.where(np.isfinite(rows.min(0)), rows.argmin(0), -1)


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 10_000))
def test_the_nearest_shape_wins_as_in_numpy(seed):
    rays, scene = random_scene(seed)
    distance, index = jitted_nearest_hit(rays, scene)
    expected_distance, expected = reference(rays, scene)
    # Rays that graze an edge may fall on either side of it in float32; those that do not are compared.
    clear = (reference(rays, scene, 1.001)[1] == expected) & (reference(rays, scene, 0.999)[1] == expected)
    assert clear.mean() > 0.9 and (expected >= 0).mean() > 0.3
    np.testing.assert_array_equal(np.asarray(index)[clear], expected[clear])
    hit = clear & (expected >= 0)
    np.testing.assert_allclose(np.asarray(distance)[hit], expected_distance[hit], rtol=1e-4, atol=2e-3)
    assert np.all(np.isinf(np.asarray(distance)[clear & (expected < 0)]))


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 10_000))
def test_hits_lie_on_the_surface_of_their_shape(seed):
    rays, scene = random_scene(seed)
    distance, index = (np.asarray(part) for part in jitted_nearest_hit(rays, scene))
    points = np.stack(rays, axis=1) * np.where(np.isfinite(distance), distance, 0)[:, None]
    for ray in np.flatnonzero(index >= 0):
        kind, i = divmod(index[ray], COUNT)
        x, y, z = local(points[ray] - scene[kind].centre[i], scene[kind], i)
        level = (max(abs(x), abs(y), abs(z)), max(np.hypot(x, y), abs(z)), np.hypot(np.hypot(x, y), z))[kind]
        # In half sizes. Where a ray grazes a round shape, float32 loses half its digits: up to a few millimetres.
        assert abs(level - 1) * scene[kind].half[i].min() < 5e-3


def test_jit_and_vmap_change_nothing():
    rays, scene = random_scene(3)
    scenes = jax.tree.map(lambda *leaves: jnp.stack(leaves), scene, random_scene(4)[1])
    distances, indices = jax.jit(jax.vmap(nearest_hit, in_axes=(None, 0)))(rays, scenes)
    plain_distance, plain_index = nearest_hit(rays, scene)
    np.testing.assert_array_equal(indices[0], plain_index)
    np.testing.assert_allclose(distances[0], plain_distance, rtol=1e-5)
    np.testing.assert_array_equal(indices[1], nearest_hit(rays, random_scene(4)[1])[1])


def test_broadcast_directions_equal_written_out_ones():
    _, scene = random_scene(5)
    azimuth, slope = np.linspace(0, 6, 40, dtype=np.float32), np.linspace(-0.4, 0.1, 9, dtype=np.float32)
    x, y, z = np.cos(azimuth)[None, :], np.sin(azimuth)[None, :], slope[:, None]
    written_out = Vectors(*(np.broadcast_to(axis, (9, 40)).ravel() for axis in (x, y, z)))
    distance, index = nearest_hit(Vectors(x, y, z), scene)
    flat_distance, flat_index = nearest_hit(written_out, scene)
    assert distance.shape == index.shape == (9, 40)
    assert np.mean(np.asarray(index).ravel() == flat_index) > 0.99
    np.testing.assert_allclose(
        np.asarray(distance).ravel()[index.ravel() == flat_index], flat_distance[index.ravel() == flat_index], rtol=1e-4
    )


@pytest.mark.parametrize("kind", [0, 1, 2])
def test_a_shape_behind_or_around_the_origin_is_not_seen(kind):
    nothing = Shapes(np.zeros((0, 3)), np.ones((0, 3)), np.zeros(0), np.zeros(0, int), np.zeros(0))
    shape = Shapes(np.zeros((1, 3)), np.ones((1, 3)), np.zeros(1), np.ones(1, int), np.zeros(1))
    forward = Vectors(np.ones(1), np.zeros(1), np.zeros(1))
    for x, expected in ((5.0, 4.0), (-5.0, np.inf), (0.0, np.inf)):
        there = shape._replace(centre=np.array([[x, 0, 0]]))
        distance, index = nearest_hit(forward, Scene(*(there if k == kind else nothing for k in range(3))))
        np.testing.assert_allclose(distance, [expected], rtol=1e-6)
        assert index == (0 if np.isfinite(expected) else -1)
