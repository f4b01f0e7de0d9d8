"""Rays against a numpy reference that tries every surface of every shape, with and without lists per sector."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scenes import NOTHING, in_world, local, pose, random_scene, reference, shapes

from sglpr_jax.sim.raycast import COLUMNS, Chance, find_candidates, nearest_hit, sector_count
from sglpr_jax.sim.shapes import Scene, Vectors

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


def candidates_of(scene: Scene, world_from_lidar: np.ndarray, **options):
    return find_candidates(scene, world_from_lidar, time=0.0, azimuth_steps=STEPS, reach_m=REACH_M, **options)


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


@settings(max_examples=10, deadline=None)
@given(st.integers(0, 10_000), poses)
def test_lists_per_sector_leave_nothing_out(seed, world_from_lidar):
    scene = numbered(random_scene(seed, COUNT))
    distance, slot, candidates = cast(scene, world_from_lidar)
    everything = candidates_of(scene, world_from_lidar)
    for kind, shapes_of_kind in zip(everything, scene, strict=True):
        assert np.isfinite(kind.nearest).sum(axis=0).max() <= len(shapes_of_kind.label)
    # One sector that is wider than the turn lists all shapes.
    one = find_candidates(scene, world_from_lidar, time=0.0, azimuth_steps=COLUMNS - 1, reach_m=REACH_M)
    everywhere = jax.tree.map(lambda values: np.repeat(values, slot.shape[1] // COLUMNS, axis=1), one)
    rays = directions(world_from_lidar)
    limit = np.full(rays.shape[:2], REACH_M, np.float32)
    all_distance, all_slot = jitted_nearest_hit(as_vectors(rays), everywhere, limit, no_chance(rays))
    np.testing.assert_array_equal(labels_of(slot, candidates), labels_of(np.asarray(all_slot), everywhere))
    np.testing.assert_array_equal(distance, all_distance)


@settings(max_examples=15, deadline=None)
@given(st.integers(0, 10_000), poses)
def test_hits_lie_on_the_surface_of_their_shape(seed, world_from_lidar):
    scene = numbered(random_scene(seed, COUNT))
    distance, slot, candidates = cast(scene, world_from_lidar)
    found = labels_of(slot, candidates)
    points = directions(world_from_lidar) * distance[..., None] + world_from_lidar[:3, 3]
    assert (found >= 0).sum() > 20
    for index, point in zip(found[found >= 0], points[found >= 0], strict=True):
        kind, i = divmod(int(index), COUNT)
        x, y, z = local(point - scene[kind].centre[i], scene[kind], i)
        level = (max(abs(x), abs(y), abs(z)), max(np.hypot(x, y), abs(z)), np.hypot(np.hypot(x, y), z))[kind]
        # Where a ray grazes a round shape, float32 loses half its digits: up to some millimetres.
        assert abs(level - 1) * scene[kind].half[i].min() < 1e-2


def test_of_too_many_shapes_in_a_sector_the_nearest_are_kept():
    row = shapes(*((5.0 + 2 * i, 0, 0, 0.2, 0.2, 2, 0, i) for i in range(10)))
    (poles, *_) = candidates_of(Scene(row, NOTHING, NOTHING), pose(), slots=(4, 4, 4))
    np.testing.assert_array_equal(poles.label[:, 0], [0, 1, 2, 3])
    np.testing.assert_allclose(poles.nearest[:, 0], [4.8, 6.8, 8.8, 10.8], rtol=1e-6)
    assert np.isinf(poles.nearest[:, 2]).all()


@pytest.mark.parametrize("kind", [0, 1, 2])
def test_a_shape_around_the_sensor_is_not_seen_and_one_above_is(kind):
    for z, seen in ((0.0, False), (2.0, True)):
        dome = shapes((0, 0, z, 30, 30, 1, 0, 7))
        _, slot, _ = cast(Scene(*(dome if k == kind else NOTHING for k in range(3))), pose(0.5))
        assert np.any(slot >= 0) == seen


def test_nothing_beyond_the_limit_is_hit():
    scene, where = random_scene(1, COUNT), pose()
    rays = directions(where)
    near = np.full(rays.shape[:2], 15.0, np.float32)
    distance, slot = map(
        np.asarray, jitted_nearest_hit(as_vectors(rays), candidates_of(scene, where), near, no_chance(rays))
    )
    far_distance, _, _ = cast(scene, where)
    np.testing.assert_array_equal(distance, np.minimum(far_distance, 15))
    assert np.all((slot < 0) == (distance == 15)) and np.any(slot >= 0)


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
    through, through_slot, _ = cast(
        scene, pose(), no_chance(rays)._replace(depth=np.full(rays.shape[:2], 9.0, np.float32))
    )
    ahead = (slot >= 0) & (rays[..., 0] > 0.9)
    np.testing.assert_allclose((deep - plain)[ahead], 0.5, atol=1e-4)
    assert np.all(through_slot[ahead] == -1) and np.all(through[ahead] == REACH_M)


@pytest.mark.slow
def test_jit_and_vmap_change_nothing():
    where = [pose(), pose(1, -2, 0.3, yaw=0.5, pitch=0.1)]
    rays = [as_vectors(directions(w)) for w in where]
    candidates = [candidates_of(random_scene(i, COUNT), w) for i, w in enumerate(where)]
    chance, limit = no_chance(directions(where[0])), jnp.full(rays[0].x.shape, REACH_M)
    stacked = jax.tree.map(lambda *leaves: jnp.stack(leaves), *zip(rays, candidates, strict=True))
    distances, slots = jax.jit(jax.vmap(lambda one: nearest_hit(*one, limit, chance)))(stacked)
    for i in range(2):
        distance, slot = jitted_nearest_hit(rays[i], candidates[i], limit, chance)
        np.testing.assert_array_equal(slots[i], slot)
        np.testing.assert_allclose(distances[i], distance, rtol=1e-5)


def test_turning_scene_and_sensor_together_changes_nothing():
    scene, where = numbered(random_scene(5, COUNT)), pose(1, 2, 0.5, yaw=0.4, pitch=0.1, roll=-0.05)
    turn = pose(40, -30, 7, yaw=1.1)
    turned = Scene(*(kind._replace(centre=in_world(kind.centre, turn), yaw=kind.yaw + 1.1) for kind in scene))
    distance, slot, candidates = cast(scene, where)
    turned_distance, turned_slot, turned_candidates = cast(turned, turn @ where)
    same = labels_of(slot, candidates) == labels_of(turned_slot, turned_candidates)
    assert same.mean() > 0.998
    np.testing.assert_allclose(distance[same], turned_distance[same], rtol=1e-4, atol=5e-3)
