"""Sceneries where places repeat: drives, revisits, and the space around the vehicle."""

import numpy as np
import pytest

from sglpr_jax.sim import recording as sim_recording
from sglpr_jax.sim.drive import drive_seed
from sglpr_jax.sim.ground import relief_height, surface_height
from sglpr_jax.sim.labels import BUILDING, FENCE, POLE
from sglpr_jax.sim.placement import HEAD_ROOM_M, distances, footprint_distance
from sglpr_jax.sim.recording import plan_drive, simulate_repeating
from sglpr_jax.sim.sceneries import REPEATING
from sglpr_jax.sim.sceneries.site import STEP_M, PaintedStrip, build, driven_line, painted_ground
from sglpr_jax.sim.sensor import Sensor
from sglpr_jax.sim.shapes import Shapes
from sglpr_jax.sim.world import Levels

SENSOR = Sensor(elevations_deg=(10.0, 2.0, -2.0, -8.0), azimuth_steps=64, min_range_m=0.5)
SCANS = 60
names = pytest.mark.parametrize("name", REPEATING)


def drive(name: str, revisit="none", seed: int = 3):
    return simulate_repeating(name, scans=SCANS, seed=seed, sensor=SENSOR, revisit=revisit)


def low_shapes(world) -> Shapes:
    """What stands beside the vehicle and not above it."""
    joined = Shapes(*(np.concatenate(values) for values in zip(*world.scene, strict=True)))
    above = joined.centre[:, 2] - joined.half[:, 2] - relief_height(world.ground.relief, joined.centre[:, :2])
    low = (above < HEAD_ROOM_M) & ~joined.velocity.any(axis=1)
    return Shapes(*(values[low] for values in joined))


@names
@pytest.mark.parametrize("revisit", ("none", "same"))
def test_a_drive_shows_the_scenery_stays_clear_and_returns_as_asked(name, revisit, monkeypatch):
    planned = []
    monkeypatch.setattr(sim_recording, "plan_drive", lambda *a, **k: planned.append(plan_drive(*a, **k)) or planned[0])
    recording, scenery = drive(name, revisit), REPEATING[name]
    poses, positions = recording.poses.world_from_lidar, recording.positions
    spacing = np.linalg.norm(np.diff(positions, axis=0), axis=1)
    assert np.max(spacing / np.diff(recording.times)) < 1.5 * scenery.speed_mps[1]
    turns = poses[:, :3, :3] @ poses[:, :3, :3].transpose(0, 2, 1)
    np.testing.assert_allclose(turns, np.tile(np.eye(3), (SCANS, 1, 1)), atol=1e-9)
    apart, older = np.linalg.norm(positions[:, None] - positions, axis=2), np.subtract.outer(*2 * [recording.times])
    nearest = np.where(older > 30, apart, np.inf).min(axis=1)
    if revisit == "none":
        assert nearest.min() > scenery.other_m
        points, labels = recording.render(SCANS // 2)
        assert 40 < len(points) == len(labels) and len(set(labels.tolist())) > 1
    else:
        assert (nearest < np.median(spacing) / 2 + 2 * scenery.right_m + scenery.sway_m + 0.5).mean() > 0.2
    ((world, path),) = planned
    driven = path.xy if world.levels is None else world.levels.along(path.xy)[0]
    assert distances(low_shapes(world), driven, reach_m=3.0).min() > 0.9 * scenery.clearance_m


WALLED = sorted(REPEATING.keys() - {"car_park", "orchard", "vineyard", "solar", "terminal", "forest", "field"})


@pytest.mark.parametrize("name", WALLED)
def test_no_wall_is_left_out(name):
    scenery, rng, revisit = REPEATING[name], np.random.default_rng(8), "opposite"
    site = scenery.site(rng, 75 * scenery.speed_mps[0] / 1.5, scenery.is_closed(revisit))
    line = driven_line(rng, site, revisit, right_m=scenery.right_m, sway_m=scenery.sway_m)
    counts = [
        np.isin(build(site, line, clearance_m=clearance).scene.boxes.label, (BUILDING, FENCE)).sum()
        for clearance in (0.0, scenery.clearance_m)
    ]
    assert counts[0] == counts[1] > 0


def test_traffic_on_the_highway_keeps_to_other_lanes():
    scenery = REPEATING["highway"]
    world, path = plan_drive(scenery, drive_seed(1, "highway"), scans=SCANS, revisit="opposite", rate_hz=4.0)
    boxes = world.scene.boxes
    movers = np.flatnonzero(boxes.velocity.any(axis=1))
    assert len(movers) > 100
    middle = (boxes.since[movers] + boxes.until[movers])[:, None] / 2
    ground = surface_height(world.ground, boxes.centre[movers, :2] + boxes.velocity[movers] * middle)
    above = boxes.centre[movers, 2] - boxes.half[movers, 2] - ground
    assert above.min() > 0.2 and above.max() < 1.1
    for time, xy in zip(path.times[::20], path.xy[::20], strict=True):
        there = movers[(boxes.since[movers] <= time) & (time < boxes.until[movers])]
        away = xy - (boxes.centre[there, :2] + boxes.velocity[there] * time)
        assert len(there) > 3
        assert footprint_distance(away, boxes.yaw[there], boxes.half[there]).min() > scenery.clearance_m


def test_strips_are_painted_left_of_the_line_and_dashes_with_gaps():
    line = np.stack([np.arange(0, 20, STEP_M), np.zeros(200)], axis=1)
    ground = painted_ground(1, [PaintedStrip(line, 0.0, 2.0, POLE), PaintedStrip(line, -2.0, -1.0, 7, 4.0)])
    assert np.isclose((ground.label == POLE).sum() / 16, 40, atol=4)
    assert np.isclose((ground.label == 7).sum() / 16, 12, atol=3)


def test_an_unknown_name_is_an_error():
    with pytest.raises(ValueError, match=r"scenery among walls, .* found 'moon'"):
        simulate_repeating("moon")


LEVELS = Levels(rise_m=3.0, pitch_m=50.0, ramp_y_m=10.0, top_m=0.0, foot_m=20.0)


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
