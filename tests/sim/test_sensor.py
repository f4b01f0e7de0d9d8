"""A turn of the sensor over small worlds in which every return is known."""

import dataclasses

import jax
import numpy as np
import pytest
from surfaces import FLAT, NOTHING, pose, shapes, striped_ground

from sglpr_jax.se3 import transformed
from sglpr_jax.sim.ground import Relief
from sglpr_jax.sim.labels import BUILDING, POLE, ROAD, TERRAIN, VEGETATION
from sglpr_jax.sim.sensor import SENSORS, Sensor, scan, scattered
from sglpr_jax.sim.shapes import Scene
from sglpr_jax.sim.world import World

ELEVATIONS = (2.0, -1.0, -4.0, -8.0, -12.0, -16.0, -20.0, -24.0)
EXACT = Sensor(
    elevations_deg=ELEVATIONS,
    azimuth_steps=60,
    min_range_m=0.0,
    range_noise_m=0.0,
    dropout=0.0,
    edge_share=0.0,
    faintest_echo=1e-9,
)
FINE = dataclasses.replace(EXACT, azimuth_steps=360)
KEY = jax.random.key(0)
POLE_AHEAD = (5, 0, 1, 0.5, 0.5, 3, 0, POLE)
TILTED = [pose(-6, 3, 1.8, yaw=1.0, pitch=0.06, roll=-0.08), pose(2, -5, 2.2, yaw=-2.5, pitch=-0.1, roll=0.05)]


def walled_world(*poles: tuple[float, ...], relief: Relief = FLAT, glass: float = 0.0) -> World:
    """A wall whose face is the plane x = 10, on ground that is road for y > 0 and, KERB_M higher, terrain elsewhere."""
    wall = shapes((11, 0, 3, 1, 40, 6, 0, BUILDING), glass=glass)
    return World(Scene(wall, shapes(*poles), NOTHING), striped_ground(relief, ROAD, TERRAIN))


@pytest.mark.parametrize("where", [pose(z=1.73), *TILTED])
def test_wall_and_ground_coincide_in_the_world_from_every_pose(where):
    points, labels = scan(KEY, walled_world(), where, sensor=EXACT)
    world = transformed(where, points[:, :3])
    wall, ground = labels == BUILDING, labels != BUILDING
    assert wall.sum() > 30 and ground.sum() > 100
    np.testing.assert_allclose(world[wall, 0], 10, atol=1e-3)
    clear_of_kerb = ground & (np.abs(world[:, 1]) > 0.5) & (np.linalg.norm(points[:, :3], axis=1) < 20)
    on_road = world[clear_of_kerb, 1] > 0
    np.testing.assert_allclose(world[clear_of_kerb, 2], np.where(on_road, 0, 0.12), atol=2e-3)
    np.testing.assert_array_equal(labels[clear_of_kerb], np.where(on_road, ROAD, TERRAIN))


def test_points_come_laser_by_laser_counter_clockwise():
    points, labels = scan(KEY, walled_world(), pose(z=1.73), sensor=EXACT)
    elevation = np.degrees(np.arctan2(points[:, 2], np.hypot(points[:, 0], points[:, 1])))
    azimuth = np.arctan2(points[:, 1], points[:, 0]) % (2 * np.pi)
    laser = np.abs(elevation[:, None] - np.array(ELEVATIONS)[None, :]).argmin(1)
    assert np.all(np.diff(laser) >= 0) and len(set(laser)) == len(ELEVATIONS)
    # Rounding may put a point of azimuth 0 just below 2 pi.
    order = np.round(azimuth / (2 * np.pi) * 60).astype(int) % 60
    assert np.all(np.diff(laser * 60 + order) > 0)
    assert points.dtype == np.float32 and labels.dtype == np.int32


def test_the_vehicle_hides_what_is_below_it():
    sensor = dataclasses.replace(FINE, shadows_deg=((-20.0, 30.0, -10.0),))
    points, labels = scan(KEY, walled_world(), pose(z=1.73), sensor=sensor)
    plain, _ = scan(KEY, walled_world(), pose(z=1.73), sensor=FINE)
    azimuth = np.degrees(np.arctan2(points[:, 1], points[:, 0]))
    low = points[:, 2] / np.linalg.norm(points[:, :3], axis=1) < -0.18
    assert len(points) == len(labels) and not np.any(low & (azimuth > -20) & (azimuth < 30))
    assert len(plain) - len(points) == 4 * 51


def test_the_key_alone_decides_the_noise():
    noisy = Sensor(elevations_deg=ELEVATIONS, azimuth_steps=60)
    leafy = walled_world()
    crown = shapes((6, 0, 2, 1, 4, 3, 0, VEGETATION), roughness=0.3, porosity=0.4)
    leafy = leafy._replace(scene=leafy.scene._replace(ellipsoids=crown))
    first, again, other = (
        scan(jax.random.key(seed), leafy, pose(z=1.73), sensor=noisy)[0].tobytes() for seed in (1, 1, 2)
    )
    assert first == again != other


@pytest.mark.parametrize("name", ["hdl64e", "mid360", "avia"])
def test_presets_scan_their_whole_field_of_view(name):
    sensor = dataclasses.replace(SENSORS[name], azimuth_steps=200)
    points, labels = scan(KEY, walled_world(POLE_AHEAD), pose(z=sensor.height_m), sensor=sensor)
    assert len(points) == len(labels) > 0.3 * len(sensor.elevations_deg) * 200
    assert np.all(np.isfinite(points)) and {BUILDING, POLE, ROAD, TERRAIN} == set(labels.tolist())
    distance = np.linalg.norm(points[:, :3], axis=1)
    assert sensor.min_range_m <= distance.min() and distance.max() < sensor.max_range_m
    assert points[:, 3].min() >= 0 and points[:, 3].max() <= 1


@pytest.mark.parametrize("entry", [np.nan, 2.0])
def test_a_pose_that_is_not_rigid_is_refused(entry):
    bent = pose(z=1.73)
    bent[0, 1] = entry
    with pytest.raises(ValueError, match="rotation and translation"):
        scan(KEY, walled_world(), bent, sensor=EXACT)


def test_a_pattern_that_does_not_repeat_fills_its_field_of_view():
    sensor = SENSORS["mid360"]
    scans = [scattered(sensor.elevations_deg, sensor.azimuth_steps, time=0.1 * i) for i in range(30)]
    assert -7 <= np.min(scans) < -6.9 and 51.9 < np.max(scans) <= 52
    assert np.abs(np.diff(np.sort(np.array(scans)[:, 3, 5]))).max() < 0.4  # of a band of 2.95 degrees
    cells = [np.unique(np.floor(one).astype(int) * 360 + np.arange(1000) * 360 // 1000) for one in (scans[0], scans)]
    assert len(cells[0]) < 0.85 * 59 * 360 and len(cells[1]) > 0.98 * 59 * 360
