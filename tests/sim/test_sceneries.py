"""Sceneries where places repeat: drives, revisits, and the space around the vehicle."""

import numpy as np
import pytest

from sglpr_jax.sim.drive import drive_seed, speeds
from sglpr_jax.sim.ground import relief_height
from sglpr_jax.sim.objects import BUILDING, FENCE, NO_RETURN, POLE
from sglpr_jax.sim.placing import HEAD_ROOM_M, distances, footprint_distance
from sglpr_jax.sim.recording import SimulatedRecording
from sglpr_jax.sim.repeating import driven_line, plan_drive, simulate_repeating
from sglpr_jax.sim.routes import REVISITS, Revisit
from sglpr_jax.sim.sceneries import REPEATING
from sglpr_jax.sim.sceneries.parking import HALF_M, RAMP_M, TURN_M, WIDE_M
from sglpr_jax.sim.sceneries.site import STEP_M, build, painted_ground, rows
from sglpr_jax.sim.sceneries.site import Strip as GroundStrip
from sglpr_jax.sim.sensor import Sensor
from sglpr_jax.sim.shapes import Shapes
from sglpr_jax.sim.world import Levels

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
@pytest.mark.parametrize("seed", range(2))
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
    assert distances(low_shapes(world), driven, reach_m=3.0).min() > 0.9 * scenery.clearance_m
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


def test_rays_beyond_the_deck_of_a_bridge_do_not_return():
    recording = drive("bridge")
    for i in (10, 30):
        points, labels = recording.render(i)
        assert NO_RETURN not in labels
        aside = np.abs(points[:, 1])[(np.abs(points[:, 0]) < 15) & (labels != BUILDING)]
        assert aside.max() < 12
    assert np.linalg.norm(np.diff(recording.positions, axis=0), axis=1).sum() > 500


def test_a_closed_way_through_rows_has_the_length_asked_for():
    plan = rows(400.0, run_m=60.0, pitch_m=20.0, closed=True, back_m=7.0, corner_m=2.0)
    assert plan.count % 2 == 0
    assert np.isclose(len(plan.line) * STEP_M, 400.0, rtol=0.1)


def test_strips_are_painted_left_of_the_line_and_dashes_with_gaps():
    line = np.stack([np.arange(0, 20, STEP_M), np.zeros(200)], axis=1)
    ground = painted_ground(1, [GroundStrip(line, 0.0, 2.0, POLE), GroundStrip(line, -2.0, -1.0, 7, 4.0)])
    assert np.isclose((ground.label == POLE).sum() / 16, 40, atol=4)
    assert np.isclose((ground.label == 7).sum() / 16, 12, atol=3)


def test_an_unknown_name_is_an_error():
    with pytest.raises(ValueError, match=r"scenery among walls, .* found 'moon'"):
        simulate_repeating("moon")


DENSE = Sensor(elevations_deg=(10.0, 2.0, -2.0, -12.0), azimuth_steps=320, min_range_m=0.5, range_noise_m=0.0)
LEVELS = Levels(rise_m=3.0, pitch_m=50.0, ramp_y_m=10.0, top_m=0.0, foot_m=20.0)


def up(revisit: Revisit = "none", scans: int = 150) -> SimulatedRecording:
    return simulate_repeating("storeys", scans=scans, seed=3, sensor=DENSE, revisit=revisit)


def xyz(recording: SimulatedRecording) -> np.ndarray:
    return recording.poses.world_from_lidar[:, :3, 3]


def on_ramp(recording: SimulatedRecording) -> np.ndarray:
    return xyz(recording)[:, 1] > WIDE_M + HALF_M - 1


def heights(recording: SimulatedRecording) -> np.ndarray:
    """Height of the storey of each scan that is on no ramp, in metres."""
    return np.round(xyz(recording)[~on_ramp(recording), 2] - DENSE.height_m, 2)


def test_a_path_up_and_down_a_ramp():
    x = np.concatenate([np.full(12, 22.0), np.arange(22, -2, -0.5), np.arange(-2, 22, 0.5), np.full(12, 22.0)])
    y = np.concatenate([np.arange(12.0), np.full(96, 12.0), np.arange(12.0)[::-1]])
    there, ground, slope = LEVELS.along(np.stack([x, y], axis=1))
    assert ground[0] == ground[-1] == 0 and ground.max() == 3
    assert np.abs(np.diff(ground)).max() < 0.15
    assert set(np.round(there[:, 1] - y)) == {0, 50}
    np.testing.assert_array_equal(there[:, 0], x)
    measured = np.gradient(ground[12:60], x[12:60])
    np.testing.assert_allclose(slope[13:59, 0], measured[1:-1], atol=0.01)


def test_up_through_all_storeys():
    recording = up()
    storey = np.unique(heights(recording))
    rise = np.diff(storey)
    assert 3 <= len(storey) <= 6 and storey[0] == 0
    np.testing.assert_allclose(rise, rise[0], atol=0.02)
    assert 3.0 <= rise[0] <= 3.6
    assert np.all(np.diff(heights(recording)) >= 0)
    lowest, highest = (xyz(recording)[~on_ramp(recording)][heights(recording) == z, :2] for z in storey[[0, -1]])
    apart = np.linalg.norm(lowest[:, None] - highest, axis=2).min(axis=1)
    assert np.median(apart) < 2  # each storey is driven along the same way


@pytest.mark.parametrize("revisit", ("none", "opposite"))
def test_a_car_climbs_and_tilts_on_ramps_without_jumps(revisit):
    recording = up(revisit, scans=1500)
    poses = recording.poses.world_from_lidar
    step = np.diff(poses[:, :3, 3], axis=0)
    assert np.linalg.norm(step, axis=1).max() < 2 and np.abs(step[:, 2]).max() < 0.25
    ahead = (poses[1:, :3, 0] + poses[:-1, :3, 0]) / 2
    climbs = np.abs(step[:, 2]) > 0.02
    assert climbs.sum() > 20
    climb = np.degrees(np.arcsin(step[climbs, 2] / np.linalg.norm(step[climbs], axis=1)))
    assert np.abs(climb - np.degrees(np.arcsin(ahead[climbs, 2]))).max() < 3
    assert 4 < np.abs(climb).max() < 16


@pytest.mark.slow
def test_scans_of_all_storeys_show_the_same_walls_at_the_height_of_their_storey():
    recording = up()
    size = np.array([np.ptp(xyz(recording)[:, 0]) + 2 * TURN_M, HALF_M + WIDE_M + RAMP_M + 3.0])
    rows = np.flatnonzero(~on_ramp(recording))
    for i in rows[:: len(rows) // 3]:
        points, _ = recording.render(int(i))
        pose = recording.poses.world_from_lidar[i]
        there = points[:, :3] @ pose[:3, :3].T + pose[:3, 3]
        assert np.all(np.ptp(there[:, :2], axis=0) < size + 2)
        assert there[:, 0].min() > -TURN_M - 0.5 and there[:, 1].min() > -HALF_M - 0.5
        above = there[:, 2] - (pose[2, 3] - DENSE.height_m)
        assert -0.2 < above.min() < 0.2 and above.max() < 3.5
