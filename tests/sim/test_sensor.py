"""A turn of the sensor over small worlds in which every return is known."""

import jax
import numpy as np
import pytest

from sglpr_jax.sim import Sensor, World, build_world, scan
from sglpr_jax.sim.frontage import BUILDING, POLE, ROAD, TERRAIN
from sglpr_jax.sim.shapes import Scene, Shapes
from sglpr_jax.sim.world import Ground

ELEVATIONS = (2.0, -1.0, -4.0, -8.0, -12.0, -16.0, -20.0, -24.0)
EXACT = Sensor(elevations_deg=ELEVATIONS, azimuth_steps=60, range_noise_m=0.0, dropout=0.0)
KEY = jax.random.key(0)


def shapes(*rows: tuple[float, ...]) -> Shapes:
    """Rows of x, y, z, three half sizes, yaw, label."""
    table = np.array(rows, dtype=float).reshape(-1, 8)
    return Shapes(table[:, :3], table[:, 3:6], table[:, 6], table[:, 7].astype(int), np.zeros(len(table)))


def walled_world(*poles: tuple[float, ...]) -> World:
    """A wall whose face is the plane x = 10, on a ground that is road for y > 0 and terrain elsewhere."""
    label = np.full((400, 400), TERRAIN, np.uint8)
    label[200:] = ROAD
    wall = shapes((11, 0, 3, 1, 40, 3, 0, BUILDING))
    return World(Scene(wall, shapes(*poles), shapes()), Ground(label, np.array([-50.0, -50])), np.zeros(2), np.zeros(2))


def pose(x: float = 0, y: float = 0, yaw: float = 0, z: float = 1.73) -> np.ndarray:
    cos, sin = np.cos(yaw), np.sin(yaw)
    return np.array([[cos, -sin, 0, x], [sin, cos, 0, y], [0, 0, 1, z], [0, 0, 0, 1]])


def in_world(points: np.ndarray, world_from_lidar: np.ndarray) -> np.ndarray:
    return points[:, :3] @ world_from_lidar[:3, :3].T + world_from_lidar[:3, 3]


@pytest.mark.parametrize("where", [pose(), pose(-6, 3, 1.0), pose(2, -5, -2.5)])
def test_wall_and_ground_coincide_in_the_world_from_every_pose(where):
    points, labels = scan(KEY, walled_world(), where, sensor=EXACT)
    world = in_world(points, where)
    wall, ground = labels == BUILDING, labels != BUILDING
    assert wall.sum() > 30 and ground.sum() > 100
    np.testing.assert_allclose(world[wall, 0], 10, atol=1e-3)
    np.testing.assert_allclose(world[ground, 2], 0, atol=1e-3)
    inland = np.abs(world[:, 1]) < 45
    clear_of_edge = ground & inland & (np.abs(world[:, 1]) > 1e-3)
    np.testing.assert_array_equal(labels[clear_of_edge], np.where(world[clear_of_edge, 1] > 0, ROAD, TERRAIN))


def test_points_come_laser_by_laser_counter_clockwise():
    points, labels = scan(KEY, walled_world(), pose(), sensor=EXACT)
    elevation = np.degrees(np.arctan2(points[:, 2], np.hypot(points[:, 0], points[:, 1])))
    azimuth = np.arctan2(points[:, 1], points[:, 0]) % (2 * np.pi)
    laser = np.abs(elevation[:, None] - np.array(ELEVATIONS)[None, :]).argmin(1)
    assert np.all(np.diff(laser) >= 0) and len(set(laser)) == len(ELEVATIONS)
    # Rounding may put a point of azimuth 0 just below 2 pi.
    order = np.round(azimuth / (2 * np.pi) * 60).astype(int) % 60
    assert np.all(np.diff(laser * 60 + order) > 0)
    assert points.dtype == np.float32 and labels.dtype == np.int32


def test_a_nearer_shape_hides_the_wall():
    points, labels = scan(KEY, walled_world((5, 0, 1, 0.5, 0.5, 3, 0, POLE)), pose(), sensor=EXACT)
    ahead = np.abs(np.arctan2(points[:, 1], points[:, 0])) < 0.05
    high = points[:, 2] > -1.5
    assert np.all(labels[ahead & high] == POLE)
    np.testing.assert_allclose(points[ahead & high][:, 0], 4.5, atol=1e-3)


def test_turning_world_and_sensor_together_changes_nothing():
    world = walled_world((5, 2, 1, 0.5, 0.5, 3, 0, POLE))
    turn = pose(30, -12, 0.7, z=0)
    turned_shapes = (part._replace(centre=in_world(part.centre, turn), yaw=part.yaw + 0.7) for part in world.scene)
    turned = world._replace(scene=Scene(*turned_shapes))
    points, labels = scan(KEY, world, pose(-3, 1, 0.3), sensor=EXACT)
    turned_points, turned_labels = scan(KEY, turned, turn @ pose(-3, 1, 0.3), sensor=EXACT)
    np.testing.assert_allclose(points, turned_points, atol=2e-3)
    standing = np.isin(labels, (BUILDING, POLE))  # the ground's raster cannot be turned
    np.testing.assert_array_equal(labels[standing], turned_labels[standing])


def test_noise_dropout_and_range_limit():
    real = Sensor(elevations_deg=ELEVATIONS, azimuth_steps=1000, max_range_m=30.0, range_noise_m=0.05, dropout=0.2)
    points, labels = scan(KEY, walled_world(), pose(), sensor=real)
    assert np.linalg.norm(points[:, :3], axis=1).max() < 30
    # Along the ray, so a wall point's x is off by the noise times the cosine of the angle between them.
    wall = points[labels == BUILDING]
    error = (wall[:, 0] - 10) * np.linalg.norm(wall[:, :3], axis=1) / wall[:, 0]
    assert abs(error.std() - 0.05) < 0.01 and abs(error.mean()) < 0.01
    everything = Sensor(elevations_deg=ELEVATIONS, azimuth_steps=1000, max_range_m=30.0, dropout=0.0)
    share = len(points) / len(scan(KEY, walled_world(), pose(), sensor=everything)[0])
    assert abs(share - 0.8) < 0.02


def test_the_key_alone_decides_the_noise():
    noisy = Sensor(elevations_deg=ELEVATIONS, azimuth_steps=60)
    first, again, other = (
        scan(jax.random.key(seed), walled_world(), pose(), sensor=noisy)[0].tobytes() for seed in (1, 1, 2)
    )
    assert first == again != other


def test_of_too_many_shapes_those_that_look_largest_are_kept():
    far = [(x, y, 1, 0.2, 0.2, 1, 0, POLE) for x in range(-60, -20, 2) for y in range(-40, 40, 2)]
    near = (5, 0, 1, 0.5, 0.5, 3, 0, POLE)
    _, labels = scan(KEY, walled_world(*far), pose(), sensor=EXACT)
    _, with_near = scan(KEY, walled_world(*far, near), pose(), sensor=EXACT)
    assert (with_near == POLE).sum() > (labels == POLE).sum()


def test_a_town_gives_a_scan_of_many_classes():
    world = build_world(0, streets=(3, 3))
    where = pose(world.streets_x[1] + 0.9, world.streets_y[1] + 15, np.pi / 2)
    points, labels = scan(KEY, world, where, sensor=Sensor(azimuth_steps=200))
    assert len(points) == len(labels) and np.all(np.isfinite(points))
    assert len(points) > 0.8 * 64 * 200 and len(set(labels.tolist())) >= 5
    assert points[:, 3].min() >= 0 and points[:, 3].max() <= 1


def test_a_tilted_pose_is_refused():
    tilted = pose()
    tilted[:3, :3] = [[0.8, 0, 0.6], [0, 1, 0], [-0.6, 0, 0.8]]
    with pytest.raises(ValueError, match="level pose"):
        scan(KEY, walled_world(), tilted, sensor=EXACT)


@pytest.mark.parametrize("bad", [{"elevations_deg": ()}, {"azimuth_steps": 0}])
def test_a_sensor_without_rays_is_refused(bad):
    with pytest.raises(ValueError, match="at least one"):
        Sensor(**bad)
