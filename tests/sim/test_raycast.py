"""Rays against a numpy reference that tries every surface of every shape, with and without lists per sector."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from surfaces import NOTHING, pose, random_scene, reference, shapes

from sglpr_jax.sim import raycast
from sglpr_jax.sim.labels import BUILDING, ROAD, TERRAIN
from sglpr_jax.sim.raycast import (
    COLUMNS,
    Chance,
    Surface,
    echo_returns,
    find_candidates,
    mix_edges,
    nearest_hit,
    sector_count,
    surface_of_shapes,
)
from sglpr_jax.sim.shapes import Scene, Shapes, Vectors

COUNT, STEPS, REACH_M = 12, 160, 90.0
jitted_nearest_hit = jax.jit(nearest_hit)
poses = st.builds(
    pose,
    *[st.floats(-3, 3)] * 3,
    yaw=st.floats(-3.2, 3.2),
    pitch=st.floats(-0.3, 0.3),
    roll=st.floats(-0.3, 0.3),
)


def directions(world_from_lidar: np.ndarray) -> np.ndarray:
    """Rays (lasers, azimuths, 3) of a turn along the world's axes, in all sectors."""
    azimuth = np.arange(sector_count(STEPS) * COLUMNS) * (2 * np.pi / STEPS)
    slope = np.linspace(-0.3, 0.2, 8)[:, None]
    rays = np.stack(np.broadcast_arrays(np.cos(azimuth)[None], np.sin(azimuth)[None], slope), axis=-1)
    rays = rays / np.linalg.norm(rays, axis=-1, keepdims=True)
    return rays @ world_from_lidar[:3, :3].T


def as_vectors(rays: np.ndarray) -> Vectors:
    return Vectors(*np.moveaxis(rays, -1, 0).astype(np.float32))


def no_chance(rays: np.ndarray) -> Chance:
    return Chance(np.zeros(rays.shape[:2], np.float32), np.zeros(rays.shape[:2], np.uint32))


def candidates_of(scene: Scene, world_from_lidar: np.ndarray):
    return find_candidates(scene, world_from_lidar, time=0.0, azimuth_steps=STEPS, reach_m=REACH_M)


def cast(scene: Scene, world_from_lidar: np.ndarray, chance: Chance | None = None):
    """Distance and slot of every ray, and the candidates."""
    rays, candidates = directions(world_from_lidar), candidates_of(scene, world_from_lidar)
    limit = np.full(rays.shape[:2], REACH_M, np.float32)
    found = jitted_nearest_hit(as_vectors(rays), candidates, limit, chance or no_chance(rays))
    return *map(np.asarray, found), candidates


def labels_of(slot: np.ndarray, candidates) -> np.ndarray:
    """Label of the shape in each ray's slot, -1 for none."""
    label = np.concatenate([kind.label for kind in candidates])
    sector = np.arange(slot.shape[1]) // COLUMNS
    return np.where(slot >= 0, label[slot, sector[None, :]], -1)


def numbered(scene: Scene) -> Scene:
    """The scene with the shapes' indices for labels."""
    return Scene(*(kind._replace(label=np.arange(i * COUNT, (i + 1) * COUNT)) for i, kind in enumerate(scene)))


@pytest.mark.slow
@settings(max_examples=25, deadline=None)
@given(st.integers(0, 10_000), poses)
def test_the_nearest_of_all_shapes_wins_from_any_pose(seed, world_from_lidar):
    scene = numbered(random_scene(seed, COUNT))
    distance, slot, candidates = cast(scene, world_from_lidar)
    found = labels_of(slot, candidates).ravel()
    rays = directions(world_from_lidar).reshape(-1, 3)
    expected_distance, expected = reference(rays, world_from_lidar[:3, 3], scene)
    # Rays that graze an edge may fall on either side of it in float32; those that do not are compared.
    clear = expected_distance < REACH_M - 1
    for grow in (0.997, 1.003):
        clear &= reference(rays, world_from_lidar[:3, 3], scene, grow)[1] == expected
    assert clear.sum() > 20  # a tilted sensor may see little but ground and sky
    np.testing.assert_array_equal(found[clear], expected[clear])
    np.testing.assert_allclose(distance.ravel()[clear], expected_distance[clear], rtol=1e-4, atol=5e-3)
    missed = np.isinf(expected_distance) & np.isinf(reference(rays, world_from_lidar[:3, 3], scene, 1.003)[0])
    assert missed.sum() > 100 and np.all(found[missed] == -1)


def test_of_too_many_shapes_in_a_sector_the_nearest_are_kept(monkeypatch):
    monkeypatch.setattr(raycast, "SLOTS", (4, 4, 4))
    row = shapes(*((5.0 + 2 * i, 0, 0, 0.2, 0.2, 2, 0, i) for i in range(10)))
    (poles, *_) = candidates_of(Scene(row, NOTHING, NOTHING), pose())
    np.testing.assert_array_equal(poles.label[:, 0], [0, 1, 2, 3])
    np.testing.assert_allclose(poles.nearest[:, 0], [4.8, 6.8, 8.8, 10.8], rtol=1e-6)
    assert np.isinf(poles.nearest[:, 2]).all()


@pytest.mark.parametrize("kind", [0, 1, 2])
def test_a_shape_around_the_sensor_is_not_seen_and_one_above_is(kind):
    for z, seen in ((0.0, False), (2.0, True)):
        dome = shapes((0, 0, z, 30, 30, 1, 0, 7))
        _, slot, _ = cast(Scene(*(dome if k == kind else NOTHING for k in range(3))), pose(0.5))
        assert np.any(slot >= 0) == seen


def test_a_share_of_the_rays_passes_through_pores_to_what_is_behind():
    crown, wall = shapes((10, 0, 0, 1, 9, 9, 0, 70), porosity=0.3), shapes((20, 0, 0, 1, 30, 30, 0, 50))
    scene = Scene(wall, NOTHING, crown)
    pores = np.random.default_rng(0).integers(2**32, size=directions(pose()).shape[:2], dtype=np.uint32)
    _, slot, candidates = cast(scene, pose(), no_chance(directions(pose()))._replace(pores=pores))
    label = labels_of(slot, candidates)
    in_crown = labels_of(cast(scene, pose())[1], candidates) != 70  # with no luck at all, every pore is open
    solid = scene._replace(ellipsoids=crown._replace(porosity=np.zeros(1)))
    behind = labels_of(cast(solid, pose())[1], candidates) == 70
    assert in_crown.all() and behind.sum() > 150
    assert abs(np.mean(label[behind] == 50) - 0.3) < 0.1
    assert np.all(np.isin(label[behind], (50, 70)))


def test_rough_shapes_return_from_within_and_let_long_shots_through():
    hedge = shapes((10, 0, 0, 0.5, 20, 20, 0, 70), roughness=0.25)
    scene, rays = Scene(hedge, NOTHING, NOTHING), directions(pose())
    plain, slot, _ = cast(scene, pose())
    deep, _, _ = cast(scene, pose(), no_chance(rays)._replace(depth=np.full(rays.shape[:2], 2.0, np.float32)))
    far = no_chance(rays)._replace(depth=np.full(rays.shape[:2], 9.0, np.float32))
    through, through_slot, _ = cast(scene, pose(), far)
    ahead = (slot >= 0) & (rays[..., 0] > 0.9)
    np.testing.assert_allclose((deep - plain)[ahead], 0.5, atol=1e-4)
    assert np.all(through_slot[ahead] == -1) and np.all(through[ahead] == REACH_M)


LASERS, AZIMUTHS = 64, 3 * COLUMNS
SPREAD = 0.5
"""Slope to the side and up of the outermost rays ahead."""


def rays_ahead() -> np.ndarray:
    """Unit vectors (LASERS, AZIMUTHS, 3) about the x axis."""
    side, up = np.linspace(-SPREAD, SPREAD, AZIMUTHS)[None, :], np.linspace(-SPREAD, SPREAD, LASERS)[:, None]
    rays = np.stack(np.broadcast_arrays(np.ones((1, 1)), side, up), axis=-1)
    return rays / np.linalg.norm(rays, axis=-1, keepdims=True)


@jax.jit
def surface_ahead(rays: Vectors, candidates) -> Surface:
    zeros = jnp.zeros((LASERS, AZIMUTHS))
    distance, slot = nearest_hit(rays, candidates, zeros + 100, Chance(zeros, zeros.astype(jnp.uint32)))
    return surface_of_shapes(rays, distance, slot, candidates)


def look_at(kind: int, shape: Shapes) -> tuple[Surface, np.ndarray]:
    """The surface that rays ahead meet, and where (rays, 3); rays that meet nothing have distance 100."""
    scene = Scene(*(shape if k == kind else NOTHING for k in range(3)))
    # All sectors list everything.
    one = find_candidates(scene, pose(), time=0.0, azimuth_steps=COLUMNS - 1, reach_m=90.0)
    candidates = jax.tree.map(lambda values: np.repeat(values, 3, axis=1), one)
    directions = rays_ahead()
    surface = surface_ahead(Vectors(*np.moveaxis(directions, -1, 0).astype(np.float32)), candidates)
    return surface, directions * np.asarray(surface.distance)[..., None]


def test_facing_of_boxes_cylinders_and_balls_is_the_cosine_to_their_normal():
    directions = rays_ahead()
    wall, _ = look_at(0, shapes((11, 0, 0, 1, 40, 40, 0, BUILDING)))
    np.testing.assert_allclose(wall.facing, directions[..., 0], atol=1e-5)
    turned, _ = look_at(0, shapes((20, 0, 0, 1, 60, 60, 0.3, BUILDING)))
    expected = directions @ [np.cos(0.3), np.sin(0.3), 0]
    np.testing.assert_allclose(turned.facing, expected, atol=1e-5)
    rod, points = look_at(1, shapes((12, 0, 0, 4, 4, 30, 0, BUILDING)))
    hit = np.asarray(rod.distance) < 90
    normal = (points - [12, 0, 0]) / 4 * [1, 1, 0]
    np.testing.assert_allclose(np.asarray(rod.facing)[hit], -np.sum(normal * directions, -1)[hit], atol=3e-3)
    egg, points = look_at(2, shapes((12, 0, 0, 3, 5, 2, 0, BUILDING)))
    hit = np.asarray(egg.distance) < 90
    normal = (points - [12, 0, 0]) / np.array([3, 5, 2]) ** 2
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    assert hit.sum() > 500
    np.testing.assert_allclose(np.asarray(egg.facing)[hit], -np.sum(normal * directions, -1)[hit], atol=5e-3)


def test_windows_cover_the_share_of_glass_in_a_lattice():
    facade = shapes((30, 0, 0, 1, 60, 60, 0, BUILDING), glass=0.36)
    surface, points = look_at(0, facade)
    window = np.asarray(surface.window)
    assert abs(window.mean() - 0.36) < 0.03
    bay, storey = (points[..., 1] / 2.5) % 1, ((points[..., 2] + 60) / 3) % 1
    inside = (np.abs(bay - 0.5) < 0.29) & (np.abs(storey - 0.5) < 0.29)
    outside = (np.abs(bay - 0.5) > 0.31) | (np.abs(storey - 0.5) > 0.31)
    assert window[inside].all() and not window[outside].any()
    assert not np.any(look_at(0, facade._replace(glass=np.zeros(1)))[0].window)


def flat_surface(distance: float, facing: float, label: int, window: bool = False) -> Surface:
    return Surface(*(jnp.full((50, 400), value) for value in (float(distance), label, float(facing), window)))


def share(surface: Surface, **options) -> float:
    chance = jax.random.uniform(jax.random.key(0), surface.distance.shape)
    return float(jnp.mean(echo_returns(chance, surface, **{"faintest_echo": 6e-6, "dropout": 0.0} | options)))


def test_road_thins_out_with_distance_and_dropout_and_windows_take_their_shares():
    road = [share(flat_surface(d, 1.73 / d, ROAD)) for d in (5, 15, 25, 35, 45, 55, 75)]
    assert min(road[:3]) > 0.99 and road[3] > 0.85 and 0.3 < road[4] < 0.7 and road[5] < 0.3 and road[6] < 0.05
    assert share(flat_surface(75, 0.7, BUILDING)) > 0.99
    assert share(flat_surface(45, 1.73 / 45, TERRAIN)) > road[4]
    assert abs(share(flat_surface(10, 0.9, BUILDING), dropout=0.2) - 0.8) < 0.02
    assert abs(share(flat_surface(10, 0.9, BUILDING, window=True)) - 0.1) < 0.02


def test_edges_are_mixed_between_their_two_sides_only():
    reach = jnp.tile(jnp.array([10.0, 10, 11.5, 11.5, 30, 30]), (500, 1))
    chance = jax.random.uniform(jax.random.key(1), reach.shape)
    returned = jnp.ones(reach.shape, bool)
    mixed = np.asarray(jax.jit(mix_edges, static_argnames="share")(chance, reach, returned, share=0.3))
    changed = mixed != np.asarray(reach)
    assert not changed[:, [0, 2, 3, 4, 5]].any()  # no jump, or one too long; the last azimuth's next is the first
    assert abs(changed[:, 1].mean() - 0.3) < 0.06
    between = mixed[changed[:, 1], 1]
    assert between.min() >= 10 and between.max() <= 11.5 and between.std() > 0.3
    lost = returned.at[:, 2].set(False)
    np.testing.assert_array_equal(mix_edges(chance, reach, lost, share=0.3)[:, 1], 10)
    np.testing.assert_array_equal(mix_edges(chance, reach, returned, share=0.0), reach)
