"""Sceneries where places repeat: drives, revisits, and the space around the vehicle."""

from itertools import pairwise

import numpy as np
import pytest

from sglpr_jax.sim.drive import drive_seed, speeds
from sglpr_jax.sim.ground import relief_height
from sglpr_jax.sim.placing import footprint_distance
from sglpr_jax.sim.raw_ids import BUILDING, FENCE, NO_RETURN, POLE
from sglpr_jax.sim.repeating import driven_line, mounted, plan_drive, simulate_repeating
from sglpr_jax.sim.routes import REVISITS
from sglpr_jax.sim.sceneries import REPEATING
from sglpr_jax.sim.sceneries.site import HEAD_ROOM_M, build, distances, striped_ground
from sglpr_jax.sim.sceneries.site import Strip as GroundStrip
from sglpr_jax.sim.sceneries.solar import solar
from sglpr_jax.sim.sceneries.terminal import HIGH_M, terminal
from sglpr_jax.sim.sceneries.ways import STEP_M, ring, road, rows
from sglpr_jax.sim.sensor import Sensor
from sglpr_jax.sim.shapes import Shapes

SENSOR = Sensor(elevations_deg=(10.0, 2.0, -2.0, -8.0), azimuth_steps=64, min_range_m=0.5)
SCANS = 60
names = pytest.mark.parametrize("name", REPEATING)
revisits = pytest.mark.parametrize("revisit", REVISITS)


def drive(name: str, revisit="none", seed: int = 3):
    return simulate_repeating(name, scans=SCANS, seed=seed, sensor=SENSOR, revisit=revisit)


def nearest_older(recording) -> np.ndarray:
    """Distance from each scan to the nearest one that is more than 30 s older."""
    positions, times = recording.positions, recording.times
    apart = np.linalg.norm(positions[:, None] - positions, axis=2)
    return np.where(times[:, None] - times > 30, apart, np.inf).min(axis=1)


def low_shapes(world) -> Shapes:
    """What stands beside the vehicle and not above it."""
    joined = Shapes(*(np.concatenate(values) for values in zip(*world.scene, strict=True)))
    above = joined.centre[:, 2] - joined.half[:, 2] - relief_height(world.ground.relief, joined.centre[:, :2])
    low = (above < HEAD_ROOM_M) & ~joined.velocity.any(axis=1)
    return Shapes(*(values[low] for values in joined))


@names
def test_a_scan_shows_the_scenery(name):
    recording = drive(name)
    assert len(recording) == SCANS
    points, labels = recording.render(SCANS // 2)
    assert len(points) > 40 and len(points) == len(labels)
    assert np.isfinite(points).all()
    assert len(set(labels.tolist())) > 1


@names
def test_the_same_seed_gives_the_same_scan_and_another_seed_another_way(name):
    first, again, other = drive(name), drive(name), drive(name, seed=4)
    np.testing.assert_array_equal(first.render(7)[0], again.render(7)[0])
    np.testing.assert_array_equal(first.poses.world_from_lidar, again.poses.world_from_lidar)
    assert not np.allclose(first.positions, other.positions)


@names
@pytest.mark.parametrize("seed", range(4))
def test_without_revisits_no_frame_returns_to_a_place(name, seed):
    assert nearest_older(drive(name, seed=seed)).min() > REPEATING[name].other_m


@names
@pytest.mark.parametrize("revisit", ("same", "opposite"))
def test_with_revisits_part_of_the_way_is_driven_again(name, revisit):
    path = drive(name, revisit, seed=5)
    spacing = np.median(np.linalg.norm(np.diff(path.positions, axis=0), axis=1))
    lanes = 2 * REPEATING[name].right_m + REPEATING[name].sway_m
    again = nearest_older(path) < spacing / 2 + lanes + 0.5
    assert again.mean() > 0.2


@names
def test_poses_are_rigid_and_continuous(name):
    recording = simulate_repeating(name, scans=400, seed=6, sensor=SENSOR, revisit="opposite")
    poses = recording.poses.world_from_lidar
    step_m = np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1)
    seconds = np.diff(recording.times)
    assert np.isfinite(poses).all() and np.all(seconds > 0)
    assert np.max(step_m / seconds) < 1.5 * REPEATING[name].speed_mps[1]
    np.testing.assert_allclose(
        poses[:, :3, :3] @ poses[:, :3, :3].transpose(0, 2, 1), np.tile(np.eye(3), (400, 1, 1)), atol=1e-9
    )


@names
@revisits
def test_the_vehicle_keeps_clear_of_what_stands(name, revisit):
    scenery = REPEATING[name]
    world, path = plan_drive(scenery, drive_seed(1, name), scans=SCANS, revisit=revisit, rate_hz=scenery.rate_hz)
    driven = path.xy if world.levels is None else world.levels.along(path.xy).xy
    assert distances(low_shapes(world), driven).min() > 0.9 * scenery.clearance_m
    assert speeds(path).max() < 2 * scenery.speed_mps[1]


@names
@revisits
def test_no_wall_is_left_out(name, revisit):
    scenery, rng = REPEATING[name], np.random.default_rng(8)
    site = scenery.site(rng, 75 * scenery.speed_mps[0] / 1.5, scenery.is_closed(revisit))
    line = driven_line(rng, site, scenery, revisit)
    counts = [
        np.isin(build(site, line, clearance_m=clearance).scene.boxes.label, (BUILDING, FENCE)).sum()
        for clearance in (0.0, scenery.clearance_m)
    ]
    assert counts[0] == counts[1]


def test_traffic_on_the_highway_keeps_to_other_lanes():
    scenery = REPEATING["highway"]
    world, path = plan_drive(scenery, drive_seed(1, "highway"), scans=SCANS, revisit="opposite", rate_hz=4.0)
    boxes = world.scene.boxes
    movers = np.flatnonzero(boxes.velocity.any(axis=1))
    assert len(movers) > 100
    for time, xy in zip(path.times[::20], path.xy[::20], strict=True):
        there = movers[(boxes.since[movers] <= time) & (time < boxes.until[movers])]
        away = xy - (boxes.centre[there, :2] + boxes.velocity[there] * time)
        assert len(there) > 3
        assert footprint_distance(away, boxes.yaw[there], boxes.half[there]).min() > scenery.clearance_m


def test_a_small_robot_carries_its_sensor_low_and_sees_near_walls():
    low = mounted(Sensor(), REPEATING["corridor"])
    assert low.height_m == 0.5 and low.min_range_m == 0.5
    assert mounted(Sensor(), REPEATING["walls"]) == Sensor()
    assert drive("corridor").mounting.height_m == 0.5


def test_the_tunnel_has_a_ceiling():
    points, _ = drive("tunnel").render(3)
    assert points[:, 2].max() > 2


def test_a_scan_in_a_yard_shows_all_of_it():
    scenery = REPEATING["yard"]
    world, _ = plan_drive(scenery, drive_seed(1, "yard"), scans=SCANS, revisit="same", rate_hz=2.0)
    walls = np.array(world.scene.boxes.label) == BUILDING
    width = 2 * world.scene.boxes.half[walls].max(axis=0)[:2]
    assert np.all(width > 15) and np.all(width < 24.5)
    points, labels = drive("yard", "same").render(10)
    bearings = np.degrees(np.arctan2(points[:, 1], points[:, 0]))[labels == BUILDING]
    assert np.histogram(bearings, bins=8, range=(-180, 180))[0].min() > 0
    assert np.linalg.norm(points[:, :2], axis=1).max() < 36


@pytest.mark.parametrize("revisit", ("same", "opposite"))
@pytest.mark.parametrize("name", ("yard", "hall"))
def test_a_closed_way_in_a_yard_or_hall_crosses_itself(name, revisit):
    xy = drive(name, revisit).positions[:, :2]
    extent = np.ptp(xy, axis=0)
    assert extent.min() > 6 and extent.max() < 60
    assert np.linalg.norm(np.diff(xy, axis=0), axis=1).sum() > 2 * extent.max()


def test_stacks_in_a_terminal_have_one_to_five_containers():
    site = terminal(np.random.default_rng(0), 300.0, False)
    heights = [spot.thing[0].size[2] / HIGH_M for spot in site.spots if spot.thing[0].kind == "box"]
    np.testing.assert_allclose(np.unique(np.round(heights, 6)), [1, 2, 3, 4, 5])


def test_panels_of_a_solar_farm_rise_along_y():
    thing = solar(np.random.default_rng(0), 300.0, False).spots[0].thing
    slats = [part for part in thing if part.kind == "box"]
    rise = np.degrees(np.arctan2(slats[-1].bottom - slats[0].bottom, slats[-1].y - slats[0].y))
    assert 15 < rise < 30
    for low, high in pairwise(slats):
        assert low.bottom + low.size[2] >= high.bottom  # no gap between two slats


def test_rays_beyond_the_deck_of_a_bridge_do_not_return():
    recording = drive("bridge")
    for i in (10, 30):
        points, labels = recording.render(i)
        assert NO_RETURN not in labels
        aside = np.abs(points[:, 1])[(np.abs(points[:, 0]) < 15) & (labels != BUILDING)]
        assert aside.max() < 12
    assert np.linalg.norm(np.diff(recording.positions, axis=0), axis=1).sum() > 500


def test_a_ring_closes():
    line = ring(200.0, straight=0.4)
    assert np.linalg.norm(line[0] - line[-1]) < 2 * STEP_M
    assert np.isclose(len(line) * STEP_M, 200.0, atol=0.5)


def test_a_closed_way_through_rows_has_the_length_asked_for():
    plan = rows(400.0, run_m=60.0, pitch_m=20.0, closed=True, back_m=7.0, corner_m=2.0)
    assert plan.count % 2 == 0
    assert np.isclose(len(plan.line) * STEP_M, 400.0, rtol=0.1)


def test_a_road_goes_on_before_and_after_the_drive():
    whole, driven = road(np.random.default_rng(0), 100.0, False)
    assert len(whole) - len(driven) == 1800


def test_strips_are_painted_left_of_the_line_and_dashes_with_gaps():
    line = np.stack([np.arange(0, 20, STEP_M), np.zeros(200)], axis=1)
    ground = striped_ground(1, [GroundStrip(line, 0.0, 2.0, POLE), GroundStrip(line, -2.0, -1.0, 7, 4.0)])
    assert np.isclose((ground.label == POLE).sum() / 16, 40, atol=4)
    assert np.isclose((ground.label == 7).sum() / 16, 12, atol=3)


def test_an_unknown_name_is_an_error():
    with pytest.raises(ValueError, match=r"scenery among walls, .* found 'moon'"):
        simulate_repeating("moon")
