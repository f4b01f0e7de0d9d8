"""Towns and the routes through them: what revisits there are, and that nothing stands in the way."""

import jax
import numpy as np
import pytest

from sglpr_jax.sim import build_world, plan_drive
from sglpr_jax.sim.drive import ROUTES, streets_needed
from sglpr_jax.sim.world import CELL_M, GROUND

CASES = [(name, scans, seed) for name in ROUTES for scans, seed in ((150, 0), (300, 0), (300, 7), (600, 3))]
RAW_IDS = {GROUND, 10, 11, 18, 20, 30, 31, 40, 44, 48, 50, 51, 70, 71, 72, 80, 81}


def drive_of(name: str, scans: int, seed: int):
    world = build_world((seed, int(name)), streets=streets_needed(name, scans))
    return world, plan_drive(np.random.default_rng(seed), name, world, scans=scans, height_m=1.73)


@pytest.mark.parametrize(("name", "scans", "seed"), CASES)
def test_a_quarter_of_the_scans_are_revisits_of_the_right_direction(name, scans, seed):
    _, drive = drive_of(name, scans, seed)
    positions, heading = drive.world_from_lidar[:, :3, 3], drive.world_from_lidar[:, :2, 0]
    distance = np.linalg.norm(positions[:, None] - positions[None], axis=-1)
    older = drive.times[:, None] - drive.times[None, :] >= 30
    distance = np.where(older, distance, np.inf)
    revisit, nearest = distance.min(1) <= 3, distance.argmin(1)
    assert 0.25 <= revisit.mean() <= 0.4
    seen_again = np.where(older.T, distance.T, np.inf).min(1) <= 3
    assert np.mean(~seen_again[~revisit]) > 0.5  # of the places, most are seen once
    same_direction = (heading * heading[nearest]).sum(1)[revisit]
    assert np.mean(same_direction < -0.9 if name == "08" else same_direction > 0.9) > 0.9


@pytest.mark.parametrize("name", ROUTES)
def test_poses_follow_the_path_evenly(name):
    _, drive = drive_of(name, 300, 1)
    steps = np.diff(drive.world_from_lidar[:, :3, 3], axis=0)
    lengths = np.linalg.norm(steps, axis=1)
    assert lengths.min() > 1.3 and lengths.max() < 2.9
    assert np.all(np.diff(drive.times) > 0.2) and drive.times[0] == 0
    ahead = (steps / lengths[:, None] * drive.world_from_lidar[:-1, :3, 0]).sum(1)
    assert ahead.min() > 0.95  # x points where the vehicle goes
    rotation = drive.world_from_lidar[:, :3, :3]
    np.testing.assert_allclose(rotation @ rotation.transpose(0, 2, 1), np.tile(np.eye(3), (300, 1, 1)), atol=1e-12)
    np.testing.assert_allclose(np.linalg.det(rotation), 1)


@pytest.mark.parametrize(("name", "scans", "seed"), CASES)
def test_nothing_stands_in_the_vehicles_way(name, scans, seed):
    world, drive = drive_of(name, scans, seed)
    for part in world.scene:
        low = (part.centre - part.half)[:, 2]
        part = jax.tree.map(lambda leaf, keep=(part.label != GROUND) & (low < 2.5): leaf[keep], part)
        offset = drive.world_from_lidar[:, None, :2, 3] - part.centre[None, :, :2]
        cos, sin = np.cos(part.yaw)[None], np.sin(part.yaw)[None]
        along = np.abs(cos * offset[..., 0] + sin * offset[..., 1]) - part.half[None, :, 0]
        across = np.abs(cos * offset[..., 1] - sin * offset[..., 0]) - part.half[None, :, 1]
        assert np.maximum(along, across).min() > 0.9  # half the width of a car


def test_a_seed_gives_one_town_and_another_seed_another():
    one, again, other = (build_world(seed, streets=(4, 3)) for seed in (5, 5, 6))
    for a, b in zip(jax.tree.leaves(one), jax.tree.leaves(again), strict=True):
        np.testing.assert_array_equal(a, b)
    assert one.scene.boxes.label.shape != other.scene.boxes.label.shape
    assert len(one.streets_x) == 4 and len(one.streets_y) == 3


def test_shapes_are_solid_and_labels_are_semantickittis():
    world = build_world(2, streets=(6, 6))
    for part in world.scene:
        assert np.all(part.half > 0) and np.all(part.roughness >= 0)
    labels = {int(label) for part in world.scene for label in np.unique(part.label)}
    assert labels | set(np.unique(world.ground.label).tolist()) == RAW_IDS


def test_blocks_differ():
    """What stands in the blocks along a street is no repetition: their buildings' areas are all different."""
    world = build_world(0, streets=(6, 6))
    boxes = world.scene.boxes
    built = boxes.label == 50
    block = np.stack(
        [
            np.searchsorted(streets, boxes.centre[built, axis])
            for axis, streets in ((0, world.streets_x), (1, world.streets_y))
        ],
        axis=1,
    )
    area = boxes.half[built, 0] * boxes.half[built, 1]
    totals = [area[np.all(block == which, axis=1)].sum().round(3) for which in np.unique(block, axis=0)]
    assert len(set(totals)) == len(totals) >= 20


def test_the_ground_goes_on_beyond_its_raster():
    ground = build_world(0, streets=(2, 2)).ground
    far = ground.around(np.array([-1000.0, 2000.0]), 20.0)
    assert np.unique(far.label).tolist() == [72]
    inside = ground.around(ground.origin + 30, 10.0)
    rows, columns = np.round((inside.origin - ground.origin) / CELL_M).astype(int)[::-1]
    size = len(inside.label)
    np.testing.assert_array_equal(inside.label, ground.label[rows : rows + size, columns : columns + size])
