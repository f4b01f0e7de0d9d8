"""The town: nothing is in the way, everything stands on the ground, all classes occur, and parked cars change."""

import jax
import numpy as np
import pytest
from town import LOOP, THERE_AND_BACK, drive

from sglpr_jax.labels import CATEGORIES, to_classes
from sglpr_jax.sim import vehicles
from sglpr_jax.sim.ground import is_raised, label_at, surface_height
from sglpr_jax.sim.raw_ids import (
    BUILDING,
    CAR,
    FENCE,
    LANE_MARKING,
    MOVING,
    PERSON,
    POLE,
    ROAD,
    TERRAIN,
    TRUNK,
    VEGETATION,
)
from sglpr_jax.sim.scenery import SCENERIES
from sglpr_jax.sim.shapes import Shapes
from sglpr_jax.sim.styles import STYLES
from sglpr_jax.sim.world import World, build_world

SEEDS = range(4)
_worlds: dict[tuple, World] = {}


def world_of(corners, seed: int, scenery: str = "town") -> World:
    if (corners, seed, scenery) not in _worlds:
        _worlds[corners, seed, scenery] = build_world(seed, *drive(corners), scenery=SCENERIES[scenery])
    return _worlds[corners, seed, scenery]


def clearance(shapes: Shapes, vehicle: np.ndarray, times: np.ndarray) -> np.ndarray:
    """Smallest distance (n,) of each shape's footprint from the vehicle while the shape is there."""
    nearest = np.full(len(shapes.label), np.inf)
    for (x, y), time in zip(vehicle, times, strict=True):
        away = np.array([x, y]) - shapes.centre[:, :2] - shapes.velocity * time
        cos, sin = np.cos(shapes.yaw), np.sin(shapes.yaw)
        along = np.abs(cos * away[:, 0] + sin * away[:, 1]) - shapes.half[:, 0]
        across = np.abs(cos * away[:, 1] - sin * away[:, 0]) - shapes.half[:, 1]
        distance = np.hypot(np.maximum(along, 0), np.maximum(across, 0))
        there = (shapes.since <= time) & (time < shapes.until)
        nearest = np.where(there, np.minimum(nearest, distance), nearest)
    return nearest


def select(shapes: Shapes, keep: np.ndarray) -> Shapes:
    return Shapes(*(leaf[keep] for leaf in shapes))


@pytest.mark.slow
@pytest.mark.parametrize("corners", [LOOP, THERE_AND_BACK])
@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.parametrize("scenery", SCENERIES)
def test_nothing_is_in_the_vehicles_way_at_any_time(corners, seed, scenery):
    trajectory, times = drive(corners)
    for shapes in world_of(corners, seed, scenery).scene:
        standing = np.all(shapes.velocity == 0, axis=1) & ~np.isin(shapes.label, list(MOVING.values()))
        always = select(shapes, standing)
        always = always._replace(since=always.since - np.inf, until=always.until + np.inf)
        assert clearance(always, trajectory, times).min() >= 1.6
        assert clearance(select(shapes, ~standing), trajectory, times).min(initial=np.inf) >= 1.6


@pytest.mark.parametrize("seed", SEEDS)
def test_what_drives_ahead_keeps_eight_metres_away(seed):
    trajectory, times = drive(LOOP)
    heading = np.unwrap(np.arctan2(*np.gradient(trajectory, axis=0).T[::-1]))
    boxes = world_of(LOOP, seed).scene.boxes
    cars = select(boxes, np.isin(boxes.label, [MOVING[CAR]]))
    seen_ahead = 0
    for (x, y), yaw, time in zip(trajectory, heading, times, strict=True):
        away = cars.centre[:, :2] + cars.velocity * time - [x, y]
        there = (cars.since <= time) & (time < cars.until)
        ahead = np.cos(yaw) * away[:, 0] + np.sin(yaw) * away[:, 1]
        beside = np.abs(np.cos(yaw) * away[:, 1] - np.sin(yaw) * away[:, 0])
        in_lane = there & (beside < 0.8)
        seen_ahead += in_lane.any()
        assert np.all(np.abs(ahead[in_lane]) - cars.half[in_lane, 0] >= 7.9)
    assert seen_ahead > 20


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


@pytest.mark.parametrize("seed", SEEDS)
def test_all_classes_occur_in_six_hundred_metres(seed):
    world = world_of(LOOP, seed)
    raw = np.concatenate([*(shapes.label for shapes in world.scene), np.unique(world.ground.label)])
    missing = set(range(20)) - set(to_classes(raw.astype(int)).tolist())
    assert {CATEGORIES[i] for i in missing} == set()
    assert {252, 253, 254, 255, 258, 259} <= set(raw.tolist())


@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.parametrize("scenery", SCENERIES)
def test_shapes_stand_on_the_ground(seed, scenery):
    world = world_of(LOOP, seed, scenery)
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


@pytest.mark.parametrize("corners", [LOOP, THERE_AND_BACK])
@pytest.mark.parametrize("seed", SEEDS)
def test_the_vehicle_drives_on_road(corners, seed):
    label = label_at(world_of(corners, seed).ground, drive(corners)[0])
    assert np.isin(label, (ROAD, LANE_MARKING)).all() and not is_raised(label).any()


@pytest.mark.slow
def test_the_outskirts_have_walls_to_their_length_and_hills_beside_the_road():
    """Some wall is longer there than any in town, and ground rises out of the plots, off the road."""
    longest, hills = {}, {}
    for scenery in SCENERIES:
        seeds = range(6 if scenery in ("outskirts", "town") else 1)
        worlds = [world_of(((0, 0), (600, 0)), seed, scenery) for seed in seeds]
        walls = [select(world.scene.boxes, world.scene.boxes.label == FENCE) for world in worlds]
        longest[scenery] = max(
            _longest_run(wall.centre[:, 0], sign * wall.centre[:, 1] > 0) for wall in walls for sign in (1, -1)
        )
        mounds = [world.scene.ellipsoids for world in worlds]
        high = [(shapes.label == TERRAIN) & (shapes.half[:, 2] > 2.9) for shapes in mounds]
        hills[scenery] = sum(int(np.sum(each)) for each in high)
        for world, shapes, each in zip(worlds, mounds, high, strict=True):
            top = shapes.centre[each, 2] + shapes.half[each, 2]
            assert np.all(top > surface_height(world.ground, shapes.centre[each, :2]) + 0.4)
    assert longest["outskirts"] > 1.5 * longest["town"] > 0
    assert hills["outskirts"] > 50 > hills["town"]


@pytest.mark.slow
def test_behind_the_face_of_a_hedgerow_leaves_thin_out_away_from_the_road():
    layers = []
    for seed in range(6):
        boxes = world_of(((0, 0), (600, 0)), seed, "lanes").scene.boxes
        # Beside the straight road, not along a side street.
        along = (boxes.label == VEGETATION) & (np.abs(np.sin(boxes.yaw)) < 0.02) & (boxes.roughness != 0.3)
        hedge = select(boxes, along)
        across = np.abs(hedge.centre[:, 1])
        faces = np.flatnonzero(hedge.roughness < 0.2)
        for i in faces.tolist():
            piece = np.flatnonzero(
                (np.abs(hedge.centre[:, 0] - hedge.centre[i, 0]) < 0.3)
                & (np.sign(hedge.centre[:, 1]) == np.sign(hedge.centre[i, 1]))
                & (np.abs(across - across[i]) < 4)
            )
            order = piece[np.argsort(across[piece])]
            assert order[0] == i and np.all(np.diff(hedge.porosity[order]) > 0)
            layers.append(len(order) - 1)
    assert len(layers) > 100 and set(layers) == {0, 1, 2, 3}


@pytest.mark.slow
def test_gardens_show_limbs_and_low_fences_that_one_sees_through():
    """Trunks branch out below their crowns, and many a fence lets half of the rays through; in town none does."""
    limbs, trunks, sparse = {}, {}, {}
    for scenery in ("town", "gardens"):
        scenes = [world_of(((0, 0), (600, 0)), seed, scenery).scene for seed in range(6)]
        limbs[scenery] = sum(int(np.sum(scene.ellipsoids.label == TRUNK)) for scene in scenes)
        round_ = [select(scene.cylinders, scene.cylinders.label == TRUNK) for scene in scenes]
        trunks[scenery] = np.median(np.concatenate([2 * found.half[:, 0] for found in round_]))
        fences = [select(scene.boxes, (scene.boxes.label == FENCE) & (scene.boxes.porosity > 0)) for scene in scenes]
        sparse[scenery] = np.concatenate([found.porosity for found in fences])
        assert all(np.all(found.half[:, 2] < 1.1) for found in fences)
    assert limbs["gardens"] > 100 and limbs["town"] == 0
    assert trunks["gardens"] > 1.1 * trunks["town"]
    assert np.all(sparse["town"] == 0.45) and np.quantile(sparse["gardens"], 0.75) > 0.6


def test_people_stand_side_by_side_in_gardens_alone():
    rng = np.random.default_rng(0)
    groups = [vehicles.people(rng) for _ in range(60)]
    assert {len(group) for group in groups} == {1, 2, 3}
    for group in groups:
        assert np.all(np.diff([part.y for part in group]) > 0.4)
        assert all(part.label == PERSON and 1.5 <= part.size[2] <= 1.9 for part in group)
    grouping = [name for name, style in STYLES.items() if style.groups]
    assert grouping == ["gardens"]


def _longest_run(along: np.ndarray, side: np.ndarray) -> float:
    """Metres of the longest row of pieces that follow each other within 6 m."""
    along = np.sort(along[side])
    pieces = np.split(along, np.flatnonzero(np.diff(along) > 6) + 1)
    return max((float(np.ptp(piece)) for piece in pieces if len(piece)), default=0.0)


@pytest.mark.slow
def test_parked_cars_come_and_go_between_two_visits():
    corners = ((0, 0), (160, 0), (160, 300), (0, 300), (0, 0), (160, 0))
    _, times = drive(corners)
    kept = gone = came = 0
    for seed in (0, 1):
        boxes = world_of(corners, seed).scene.boxes
        near = (np.abs(boxes.centre[:, 1]) < 12) & (boxes.centre[:, 0] > 5) & (boxes.centre[:, 0] < 140)
        cars = select(boxes, near & (boxes.label == CAR))
        first, second = ((cars.since <= time) & (time < cars.until) for time in (times[0] + 10, times[-1] - 10))
        kept, gone, came = kept + (first & second).sum(), gone + (first & ~second).sum(), came + (~first & second).sum()
    assert min(kept, gone, came) > 2


@pytest.mark.slow
def test_a_seed_gives_one_town_and_another_seed_another():
    one, again, other = (build_world(seed, *drive(LOOP[:3])) for seed in ((5, 1), (5, 1), (6, 1)))
    for a, b in zip(jax.tree.leaves(one), jax.tree.leaves(again), strict=True):
        np.testing.assert_array_equal(a, b)
    assert one.scene.boxes.label.shape != other.scene.boxes.label.shape


def test_rows_are_what_the_sensor_expects():
    for shapes in world_of(LOOP, 0).scene:
        count = len(shapes.label)
        assert shapes.centre.shape == shapes.half.shape == (count, 3) and shapes.velocity.shape == (count, 2)
        assert shapes.label.dtype == np.int32 and np.all(shapes.since < shapes.until)
        for share in (shapes.porosity, shapes.glass):
            assert share.min() >= 0 and share.max() <= 1


@pytest.mark.parametrize(("length_m", "shapes_at_least"), [(2.5, 0), (12.0, 20)])
def test_a_few_metres_are_a_drive_even_if_nobody_comes_by(length_m, shapes_at_least):
    trajectory = np.linspace([0, 0], [length_m, 0], 12)
    scene = build_world(0, trajectory, np.arange(12) * 0.1).scene
    assert sum(len(shapes.label) for shapes in scene) >= shapes_at_least
    assert all(shapes.label.dtype == np.int32 for shapes in scene)
