"""Point clouds and occupancy grids of a road beside a wall, on which a box drives or stands."""

import json
from pathlib import Path

import numpy as np
import pytest
from recordings import of_images, of_scans
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation

from sglpr_jax.data.formats.cloud_writers import write_cloud
from sglpr_jax.data.formats.scan_files import cloud_blocks, read_scan
from sglpr_jax.data.recording import Recording
from sglpr_jax.files import DataWarning
from sglpr_jax.maps.config import CloudConfig, OccupancyConfig
from sglpr_jax.maps.occupancy import FREE, OCCUPIED, UNKNOWN, occupancy_grid
from sglpr_jax.maps.point_cloud import point_cloud
from sglpr_jax.se3 import transform, transformed

SCANS, STEP_M, HEIGHT_M = 18, 1.2, 1.7
WALL_Y, BOX_Y, BOX_LENGTH, BOX_TOP = 8.0, 3.5, 3.0, 1.2
"""The wall is to the left of the road. The box is nearer, 1 m wide, and below the sensor."""
KEPT = CloudConfig(keep_moving=True)


def rays(beams: int) -> np.ndarray:
    """Directions (n, 3) of the rays of a sensor."""
    azimuth, elevation = np.meshgrid(np.radians(np.arange(0, 360, 0.9)), np.radians(np.linspace(-24, 10, beams)))
    flat = np.cos(elevation)
    return np.stack([flat * np.cos(azimuth), flat * np.sin(azimuth), np.sin(elevation)], axis=-1).reshape(-1, 3)


def scan(x: float, box_x: float, beams: int) -> np.ndarray:
    """Points in the LiDAR frame, from a sensor at x that looks along x."""
    directions = rays(beams)
    with np.errstate(divide="ignore"):
        ground = np.where(directions[:, 2] < 0, -HEIGHT_M / directions[:, 2], np.inf)
        wall = np.where(directions[:, 1] > 0, WALL_Y / directions[:, 1], np.inf)
        low = np.array([box_x - x, BOX_Y, -HEIGHT_M]) / directions
        high = np.array([box_x + BOX_LENGTH - x, BOX_Y + 1, BOX_TOP - HEIGHT_M]) / directions
    wall = np.where(wall * directions[:, 2] < 3.0, wall, np.inf)
    enter, leave = np.minimum(low, high).max(axis=1), np.maximum(low, high).min(axis=1)
    box = np.where((enter < leave) & (enter > 0), enter, np.inf)
    ranges = np.minimum(np.minimum(ground, wall), box)
    seen = np.isfinite(ranges) & (ranges < 40)
    return (ranges[seen, None] * directions[seen]).astype(np.float32)


def drive(*, speed: float, beams: int = 32, start_x: float = 0.0) -> tuple[Recording, np.ndarray]:
    """A drive along the wall, and its poses. The box drives `speed` metres for each scan."""
    xs = start_x + STEP_M * np.arange(SCANS)
    clouds = {Path(f"{row:06d}.bin"): scan(x, 12.0 + speed * row, beams) for row, x in enumerate(xs)}
    return of_scans(clouds), np.stack([transform(x, 0.0, 0.0) for x in xs])


def parts(points: np.ndarray) -> dict[str, np.ndarray]:
    """Points of the wall, of the ground, and of the box wherever it was."""
    is_box = (points[:, 1] > BOX_Y - 0.1) & (points[:, 1] < BOX_Y + 1.1) & (points[:, 2] > 0.35 - HEIGHT_M)
    return {
        "wall": points[points[:, 1] > WALL_Y - 0.1],
        "ground": points[points[:, 2] < 0.1 - HEIGHT_M],
        "box": points[is_box & (points[:, 1] < WALL_Y - 0.5)],
    }


@pytest.fixture(scope="module")
def moving() -> tuple[Recording, np.ndarray]:
    return drive(speed=1.5)


def test_every_point_within_reach_is_in_the_cloud_of_several_recordings_in_a_distant_frame(moving):
    recording, poses = moving
    other, other_poses = drive(speed=0.0, start_x=10.0)
    world_from_drive = transform(431_200.0, 5_411_900.0, 0.7)  # UTM
    poses, other_poses = world_from_drive @ poses, world_from_drive @ other_poses
    cloud = point_cloud([recording, other], [poses, other_poses], config=KEPT)
    tree = KDTree(cloud)
    for drive_recording, drive_poses, row in ((recording, poses, 0), (other, other_poses, 17)):
        points = drive_recording.scan(row).cloud.astype(np.float64)
        near = points[np.linalg.norm(points, axis=1) < KEPT.reach_m]
        distances_m, _ = tree.query(transformed(drive_poses[row], near))
        assert distances_m.max() < np.sqrt(3) * KEPT.voxel_m + 0.01


def test_each_voxel_has_one_point(moving):
    cloud = point_cloud([moving[0]], [moving[1]], config=CloudConfig(voxel_m=0.5, keep_moving=True))
    voxels = np.floor(cloud / 0.5)
    assert len(np.unique(voxels, axis=0)) == len(cloud)


@pytest.mark.parametrize("beams", (32, 16))
def test_a_moving_box_is_left_out_and_all_else_is_kept(beams):
    recording, poses = drive(speed=1.5, beams=beams)
    with_box = parts(point_cloud([recording], [poses], config=KEPT))
    without = parts(point_cloud([recording], [poses]))
    assert len(without["box"]) < 0.15 * len(with_box["box"])
    for name in ("wall", "ground"):
        assert len(without[name]) > 0.98 * len(with_box[name])


def test_a_box_that_stands_is_kept():
    recording, poses = drive(speed=0.0)
    with_box = parts(point_cloud([recording], [poses], config=KEPT))["box"]
    assert len(parts(point_cloud([recording], [poses]))["box"]) > 0.98 * len(with_box) > 0


def test_large_voxels_of_a_scene_at_rest_keep_all_points():
    recording, poses = drive(speed=0.0)
    kept = point_cloud([recording], [poses], config=CloudConfig(voxel_m=0.5))
    assert len(kept) > 0.99 * len(point_cloud([recording], [poses], config=CloudConfig(voxel_m=0.5, keep_moving=True)))


def test_tilted_poses_are_told(moving):
    tilted = np.eye(4)
    tilted[:3, :3] = Rotation.from_euler("x", 30, degrees=True).as_matrix()
    with pytest.warns(DataWarning, match="08: expected poses with z up, found up tilted by 30 degrees"):
        point_cloud([moving[0]], [tilted @ moving[1]])


def test_scans_without_a_pose_or_without_points_are_errors(moving):
    with pytest.raises(ValueError, match="expected a list of recordings"):
        point_cloud([moving[0]], [])
    with pytest.raises(ValueError, match="08: expected poses of 18 scans, found poses of 17"):
        point_cloud([moving[0]], [moving[1][1:]])
    images = of_images({Path("0.png"): np.zeros((128, 128), np.float32)})
    with pytest.raises(ValueError, match="08: expected scans, found ready-made images"):
        point_cloud([images], [np.eye(4)[None]])
    far = of_scans({Path("0.bin"): np.full((5, 3), 100.0, np.float32)})
    with pytest.raises(ValueError, match="08: expected scans with points, found none"):
        point_cloud([far], [np.eye(4)[None]])


@pytest.mark.parametrize("suffix", (".ply", ".pcd", ".las", ".laz"))
def test_the_files_of_a_cloud_have_its_points(suffix, tmp_path):
    points = np.random.default_rng(0).normal(0, 30, (500, 3))
    path = tmp_path / f"cloud{suffix}"
    write_cloud(path, points)
    if suffix != ".laz":  # only a map may be compressed
        np.testing.assert_allclose(read_scan(path), points, atol=6e-4)
    shift = np.array([431_200.0, 5_411_900.0, 120.0])
    write_cloud(path, points + shift)
    np.testing.assert_allclose(np.concatenate(list(cloud_blocks(path))), points + shift, atol=6e-4)


def test_another_suffix_is_an_error(tmp_path):
    with pytest.raises(ValueError, match=r"map\.txt: expected a name that ends in .ply, .pcd, .las, .laz, found .txt"):
        write_cloud(tmp_path / "map.txt", np.zeros((1, 3)))
    assert not list(tmp_path.iterdir())


def occupancy_of(path: Path, x: float, y: float) -> int:
    """Occupancy of a position by the documented rules of the map server: 100 occupied, 0 free, -1 unknown."""
    lines = dict(line.split(": ", 1) for line in path.read_text().splitlines())
    lines["image"] = json.loads(lines["image"])
    magic, size, most, pixels = (path.parent / lines["image"]).read_bytes().split(b"\n", 3)
    assert (magic, most, lines["mode"], lines["negate"]) == (b"P5", b"255", "trinary", "0")
    width, height = map(int, size.split())
    left, bottom, _ = map(float, lines["origin"].strip("[]").split(","))
    column, row = (int((value - start) / float(lines["resolution"])) for value, start in ((x, left), (y, bottom)))
    share = (255 - pixels[(height - 1 - row) * width + column]) / 255
    if share > float(lines["occupied_thresh"]):
        return 100
    return 0 if share < float(lines["free_thresh"]) else -1


def test_a_grid_has_walls_roads_and_unknown_land_and_its_files_say_where(moving, tmp_path):
    recording, poses = moving
    world_from_drive = transform(20.0, -5.0, np.pi / 2)  # the wall is at x = 20 - WALL_Y
    cloud = point_cloud([recording], [world_from_drive @ poses])
    cloud = np.concatenate([cloud, cloud[:50] * [1, 1, 0] + [0, 0, 2.6]])  # branches above the road
    path = tmp_path / "grid #2.yaml"
    occupancy_grid(cloud, config=OccupancyConfig(cell_m=0.2)).save(path)
    assert occupancy_of(path, 20.0 - WALL_Y, 5.0) == 100
    assert occupancy_of(path, 20.0, 5.0) == 0
    assert occupancy_of(path, 20.0 - BOX_Y - 0.5, 9.0) == 0  # where the box drove
    assert sorted(file.name for file in tmp_path.iterdir()) == ["grid #2.pgm", "grid #2.yaml"]


def test_a_robot_drives_over_low_steps_and_beneath_high_points():
    x, y = np.meshgrid(np.arange(0, 6, 0.1) + 0.05, np.arange(0, 4, 0.1) + 0.05)
    ground = np.stack([x, y, 0.1 * x], axis=-1).reshape(-1, 3)  # a slope of 10 %

    def grid_with(height: float) -> np.ndarray:
        things = np.array([[3.05, 2.05, 0.305 + height]])
        return occupancy_grid(np.concatenate([ground, things])).cells

    for height, expected in ((0.15, FREE), (1.0, OCCUPIED), (2.5, FREE)):
        cells = grid_with(height)
        assert cells[-21, 30] == expected
        assert (cells != FREE).sum() == (expected != FREE)
    gap = ground[(np.abs(ground[:, 0] - 3) > 0.7) | (ground[:, 1] > 2)]
    assert occupancy_grid(gap).cells[-11, 30] == UNKNOWN


def test_cells_are_free_where_the_robot_drove():
    ground = np.stack([*map(np.ravel, np.mgrid[0:6:0.09, 0:6:0.09]), np.zeros(67 * 67)], axis=1)
    hole = ground[np.abs(ground[:, 0] - 3) > 1]  # the sensor did not see the ground beneath it
    post = np.array([[1.0, 3.0, 1.0]])  # a person who walked beside the robot
    cloud = np.concatenate([hole, post])
    poses = np.stack([transform(x, 3.0, 0.0) for x in (0.5, 2.0, 5.5)])
    before, after = occupancy_grid(cloud).cells, occupancy_grid(cloud, driven=[poses]).cells
    row = -1 - 30
    assert before[row, 10] == OCCUPIED and before[row, 30] == UNKNOWN
    assert (after[row, 5:56] == FREE).all() and after[row - 3, 30] == FREE and after[row - 4, 30] == UNKNOWN
    jump = np.stack([transform(x, 3.0, 0.0) for x in (-3.0, 5.5)])  # where it was between these is not known
    assert occupancy_grid(cloud, driven=[jump]).cells[row, 30] == UNKNOWN


def test_a_grid_needs_points_and_the_right_name(tmp_path):
    with pytest.raises(ValueError, match=r"expected finite points \(n, 3\), found none"):
        occupancy_grid(np.zeros((0, 3)))
    with pytest.raises(ValueError, match=r"expected a grid of at most \d+ cells, found"):
        occupancy_grid(np.array([[0.0, 0, 0], [1e5, 1e5, 0]]))
    with pytest.raises(ValueError, match=r"grid\.pgm: expected a name that ends in .yaml, found .pgm"):
        occupancy_grid(np.zeros((1, 3))).save(tmp_path / "grid.pgm")
