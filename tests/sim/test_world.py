"""The town: nothing is in the way, everything stands on the ground, all classes occur, and parked cars change."""

import functools

import numpy as np
import pytest
from town import LOOP, THERE_AND_BACK, drive

from sglpr_jax.labels import CATEGORIES, to_classes
from sglpr_jax.sim.ground import label_at, surface_height
from sglpr_jax.sim.labels import BUILDING, LANE_MARKING, MOVING, POLE, ROAD, TRUNK
from sglpr_jax.sim.placement import footprint_distance
from sglpr_jax.sim.shapes import Shapes
from sglpr_jax.sim.styles import SCENERIES
from sglpr_jax.sim.world import World, build_world


@functools.cache
def world_of(corners, seed: int, scenery: str = "town") -> World:
    return build_world(seed, *drive(corners), scenery=SCENERIES[scenery])


def clearance(shapes: Shapes, vehicle: np.ndarray, times: np.ndarray) -> np.ndarray:
    """Smallest distance (n,) of each shape's footprint from the vehicle while the shape is there."""
    nearest = np.full(len(shapes.label), np.inf)
    for (x, y), time in zip(vehicle, times, strict=True):
        away = np.array([x, y]) - shapes.centre[:, :2] - shapes.velocity * time
        is_present = (shapes.since <= time) & (time < shapes.until)
        distance = footprint_distance(away, shapes.yaw, shapes.half)
        nearest = np.where(is_present, np.minimum(nearest, distance), nearest)
    return nearest


def select(shapes: Shapes, keep: np.ndarray) -> Shapes:
    return Shapes(*(leaf[keep] for leaf in shapes))


@pytest.mark.slow
@pytest.mark.parametrize(("corners", "scenery"), [*((LOOP, name) for name in SCENERIES), (THERE_AND_BACK, "town")])
def test_the_vehicle_drives_on_road_and_nothing_is_in_its_way_at_any_time(corners, scenery):
    trajectory, times = drive(corners)
    world = world_of(corners, 0, scenery)
    assert np.isin(label_at(world.ground, trajectory), (ROAD, LANE_MARKING)).all()
    for shapes in world.scene:
        standing = np.all(shapes.velocity == 0, axis=1) & ~np.isin(shapes.label, list(MOVING.values()))
        since, until = np.where(standing, -np.inf, shapes.since), np.where(standing, np.inf, shapes.until)
        assert clearance(shapes._replace(since=since, until=until), trajectory, times).min() >= 1.6


def test_movers_go_where_they_look_and_leave_no_gap():
    scene = world_of(LOOP, 0).scene
    boxes = select(scene.boxes, np.linalg.norm(scene.boxes.velocity, axis=1) > 2)
    along = np.cos(boxes.yaw) * boxes.velocity[:, 0] + np.sin(boxes.yaw) * boxes.velocity[:, 1]
    assert np.mean(along > 0.97 * np.linalg.norm(boxes.velocity, axis=1)) > 0.9
    ends = boxes.centre[:, :2] + boxes.velocity * boxes.until[:, None]
    begins = boxes.centre[:, :2] + boxes.velocity * boxes.since[:, None]
    same = (boxes.until[:, None] == boxes.since[None, :]) & (boxes.half[:, None] == boxes.half[None]).all(-1)
    gap = np.linalg.norm(ends[:, None] - begins[None], axis=-1)[same]
    assert len(gap) > 100 and np.median(gap) < 0.3
    assert set(boxes.label.tolist()) <= set(MOVING.values())


def test_all_classes_occur_in_six_hundred_metres():
    world = world_of(LOOP, 0)
    raw = np.concatenate([*(shapes.label for shapes in world.scene), np.unique(world.ground.label)])
    missing = set(range(20)) - set(to_classes(raw.astype(int)).tolist())
    assert {CATEGORIES[i] for i in missing} == set()
    assert {252, 253, 254, 255, 258, 259} <= set(raw.tolist())


@pytest.mark.parametrize("scenery", SCENERIES)
def test_shapes_stand_on_the_ground(scenery):
    world = world_of(LOOP, 0, scenery)
    for shapes in world.scene:
        moves = np.any(shapes.velocity != 0, axis=1)
        time = np.where(moves, shapes.since.clip(-1e6, 1e6) + shapes.until.clip(-1e6, 1e6), 0) / 2
        where = shapes.centre[:, :2] + shapes.velocity * time[:, None]
        above = shapes.centre[:, 2] - shapes.half[:, 2] - surface_height(world.ground, where)
        upright = np.isin(shapes.label, [TRUNK, POLE]) & (shapes.half[:, 2] > 0.4) & (shapes.porosity == 0)  # no limbs
        assert np.mean(np.abs(above[upright]) < 0.15) > 0.97 if upright.any() else True
        built = shapes.label == BUILDING
        assert above[built].max(initial=0) < 12.5 and np.all(above + 2 * shapes.half[:, 2] > 0.2)
        assert np.all(shapes.half > 0) and all(np.isfinite(leaf).all() for leaf in shapes[:8])


@pytest.mark.parametrize(("length_m", "shapes_at_least"), [(2.5, 0), (12.0, 20)])
def test_a_few_metres_are_a_drive_even_if_nobody_comes_by(length_m, shapes_at_least):
    trajectory = np.linspace([0, 0], [length_m, 0], 12)
    scene = build_world(0, trajectory, np.arange(12) * 0.1).scene
    assert sum(len(shapes.label) for shapes in scene) >= shapes_at_least
    assert all(shapes.label.dtype == np.int32 for shapes in scene)
