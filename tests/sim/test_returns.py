"""Which rays come back: windows, faint echoes, edges, the angle at which surfaces are met."""

import jax
import jax.numpy as jnp
import numpy as np
from scenes import NOTHING, pose, shapes

from sglpr_jax.sim.raw_ids import BUILDING, ROAD, TERRAIN, VEGETATION
from sglpr_jax.sim.raycast import COLUMNS, Chance, find_candidates, nearest_hit
from sglpr_jax.sim.returns import LEAF_FACING, Surface, echo_returns, mix_edges, nearer, surface_of_shapes
from sglpr_jax.sim.shapes import Scene, Shapes, Vectors

LASERS, AZIMUTHS = 64, 3 * COLUMNS
SPREAD = 0.5
"""Slope to the side and up of the outermost rays ahead."""


def rays_ahead() -> np.ndarray:
    """Unit vectors (LASERS, AZIMUTHS, 3) about the x axis."""
    side, up = np.linspace(-SPREAD, SPREAD, AZIMUTHS)[None, :], np.linspace(-SPREAD, SPREAD, LASERS)[:, None]
    rays = np.stack(np.broadcast_arrays(np.ones((1, 1)), side, up), axis=-1)
    return rays / np.linalg.norm(rays, axis=-1, keepdims=True)


@jax.jit
def cast(rays: Vectors, candidates) -> Surface:
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
    surface = cast(Vectors(*np.moveaxis(directions, -1, 0).astype(np.float32)), candidates)
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


def test_leaves_face_every_way():
    hedge, _ = look_at(0, shapes((11, 0, 0, 1, 40, 40, 0, VEGETATION), roughness=0.2))
    assert np.all(np.asarray(hedge.facing) == LEAF_FACING)


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
    shape = (50, 400)
    return Surface(
        *(
            jnp.full(shape, value, dtype)
            for value, dtype in ((distance, float), (label, int), (facing, float), (window, bool))
        )
    )


def share(surface: Surface, **options) -> float:
    chance = jax.random.uniform(jax.random.key(0), surface.distance.shape)
    return float(jnp.mean(echo_returns(chance, surface, **{"faintest_echo": 6e-6, "dropout": 0.0} | options)))


def test_road_thins_out_with_distance_and_walls_do_not():
    road = [share(flat_surface(d, 1.73 / d, ROAD)) for d in (5, 15, 25, 35, 45, 55, 75)]
    assert min(road[:3]) > 0.99 and road[3] > 0.85 and 0.3 < road[4] < 0.7 and road[5] < 0.3 and road[6] < 0.05
    assert share(flat_surface(75, 0.7, BUILDING)) > 0.99
    assert share(flat_surface(45, 1.73 / 45, TERRAIN)) > road[4]


def test_dropout_and_windows_take_their_shares():
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


def test_the_nearer_surface_wins():
    near, far = flat_surface(5, 0.5, ROAD), flat_surface(6, 0.9, BUILDING)
    for first, second in ((near, far), (far, near)):
        jax.tree.map(np.testing.assert_array_equal, nearer(first, second), near)
