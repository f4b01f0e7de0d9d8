"""The sensor's height and tilt: found from the ground, said by the user, and undone before a model looks."""

import dataclasses

import clouds
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from recordings import of_images

import sglpr_jax
from sglpr_jax.data.density_image import density_bev
from sglpr_jax.data.gravity import mounted
from sglpr_jax.data.mounting import MODEL_HEIGHT_M, Mounting, common_mounting, estimate_mounting, upright_from_lidar
from sglpr_jax.data.readers import open_recording
from sglpr_jax.files import DataWarning
from sglpr_jax.grid import Grid
from sglpr_jax.methods.recipe import TupleConfig
from sglpr_jax.methods.registry import handcrafted
from sglpr_jax.models.config import model_preset
from sglpr_jax.training.batches import read_batch
from sglpr_jax.training.tuples import TuplePool


def street(seed: int, *, height: float = MODEL_HEIGHT_M) -> np.ndarray:
    """Ground and walls as seen by an upright sensor so high above the ground."""
    return clouds.street(seed, height_m=height).astype(np.float32)


def turned(points: np.ndarray, *, pitch: float = 0.0, roll: float = 0.0) -> np.ndarray:
    """The points in the frame of a sensor that is pitched and rolled (degrees)."""
    p, r = np.radians([pitch, roll])
    about_y = np.array([[np.cos(p), 0, np.sin(p)], [0, 1, 0], [-np.sin(p), 0, np.cos(p)]])
    about_x = np.array([[1, 0, 0], [0, np.cos(r), -np.sin(r)], [0, np.sin(r), np.cos(r)]])
    return (points @ (about_y @ about_x)).astype(np.float32)


@pytest.mark.parametrize("height", [0.0, 4.0])
@pytest.mark.parametrize("tilt", [{}, {"pitch": 10.0, "roll": -20.0}], ids=str)
def test_height_and_tilt_are_found(height, tilt):
    found = estimate_mounting(turned(street(1, height=height), **tilt))
    assert found is not None and abs(found.height_m - height) < 0.1
    angle = np.degrees(np.arccos(np.prod(np.cos(np.radians([*tilt.values(), 0])))))
    assert abs(found.tilt_deg - angle) < 1


def test_a_sensor_that_hangs_upside_down():
    height = 2.5
    points = street(2, height=height)
    found = estimate_mounting(points * np.float32([1, -1, -1]))
    assert found is not None and abs(found.height_m - height) < 0.1 and found.tilt_deg > 178
    assert "upside down" in str(found)
    np.testing.assert_allclose(
        Mounting(height, (0.0, 0.0, -1.0)).level(points * np.float32([1, -1, -1])),
        points + np.array([0, 0, height - MODEL_HEIGHT_M]),
        atol=1e-5,
    )


def test_a_room_has_a_floor_and_a_ceiling():
    rng = np.random.default_rng(0)
    inside = rng.uniform([-6, -4, -0.8], [6, 4, 1.7], (9000, 3))
    face = rng.integers(6, size=9000)
    for axis, (low, high) in enumerate(((-6, 6), (-4, 4), (-0.8, 1.7))):
        inside[face == 2 * axis, axis], inside[face == 2 * axis + 1, axis] = low, high
    found = estimate_mounting(inside.astype(np.float32))
    assert found is not None and found.up[2] > 0.99 and abs(found.height_m - 0.8) < 0.05


@pytest.mark.parametrize(
    "points",
    [
        np.zeros((0, 3), np.float32),
        np.full((500, 3), 1e30, np.float32),
        np.random.default_rng(0).normal(scale=12, size=(4000, 3)).astype(np.float32),
        street(0)[:10],
    ],
    ids=["none", "1e30", "a ball", "ten"],
)
def test_no_ground(points):
    assert estimate_mounting(points) is None


def test_a_recording_takes_the_median_and_no_slope():
    each = [Mounting(1.0), Mounting(1.1, (0.02, 0.0, 0.9998)), Mounting(3.0), None, None]
    assert common_mounting(each) == Mounting(1.1)
    assert common_mounting([*each, None, None]) is None
    assert common_mounting([]) is None


def test_scans_that_disagree_on_which_side_is_up_follow_the_majority():
    upright, hanging = Mounting(1.0, (0.6, 0.0, 0.8)), Mounting(3.0, (-0.6, 0.0, -0.8))
    assert common_mounting([hanging, upright, None, hanging, Mounting(2.9, hanging.up)]) == hanging
    assert common_mounting([upright, upright, hanging]) == upright
    assert common_mounting([upright, hanging, hanging, upright]) is None


@settings(max_examples=25, deadline=None)
@given(st.tuples(*[st.floats(-1, 1)] * 3).filter(lambda up: np.linalg.norm(up) > 0.1), st.floats(0, 4))
def test_level_is_rigid_and_rotates_up_to_z(up, height):
    unit = np.array(up) / np.linalg.norm(up)
    mounting = Mounting(height, tuple(unit.tolist()))
    rotation = upright_from_lidar(mounting)[:3, :3]
    np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-6)
    assert np.linalg.det(rotation) == pytest.approx(1)
    np.testing.assert_allclose(rotation @ unit, [0, 0, 1], atol=1e-6)
    ground = (-height * unit).astype(np.float32)[None]
    np.testing.assert_allclose(mounting.level(ground), [[0, 0, -MODEL_HEIGHT_M]], atol=1e-5)


def test_a_strange_height_is_refused():
    for height in (np.nan, 1730.0):
        with pytest.raises(ValueError, match="expected the sensor's height above the ground in metres, found"):
            Mounting(height)


@pytest.fixture
def low_robot(tmp_path):
    """A plain folder of a sensor half a metre above the road, as float32x4, and the same scans from 1.73 m."""
    for i in range(4):
        np.column_stack([street(i, height=0.5), np.zeros(2200)]).astype("<f4").tofile(tmp_path / f"{i}.bin")
    return tmp_path, [street(i) for i in range(4)]


def test_every_road_levels(low_robot):
    folder, _ = low_robot
    recording = open_recording(folder, sensor_height=0.5)
    config = dataclasses.replace(model_preset("tiny"), grid=Grid(0.4, 64, 64), image="density")
    lifted = street(0, height=0.5) + np.float32([0, 0, 0.5 - MODEL_HEIGHT_M])
    image = sglpr_jax.scan_image(street(0, height=0.5), config, mounting=Mounting(0.5))
    np.testing.assert_array_equal(image, sglpr_jax.scan_image(lifted, config))
    pool = TuplePool([np.zeros((4, 3))], TupleConfig(negatives=0))
    frames, options = np.array([[0, 1]]), {"max_points": 20000, "share_negatives": False, "categories": 0}
    batch = read_batch([recording], pool, frames, image="density", **options)
    np.testing.assert_array_equal(batch.images[0], density_bev(lifted))
    batch = read_batch([recording], pool, frames, **options)
    np.testing.assert_array_equal(batch.points[0, : len(lifted)], lifted)
    mean = handcrafted("m2dp", config.grid)
    mean = dataclasses.replace(mean, prepare=lambda scan, angle: scan.upright_points.mean(axis=0))
    file = sglpr_jax.embed(mean, recording)
    np.testing.assert_allclose(file.descriptors[0], lifted.mean(axis=0), atol=1e-5)
    assert file.config["sensor"] == "0.50 m above the ground"


def test_layouts_that_know_their_sensor_are_left_alone_unless_asked(kitti_root, bev_root):
    assert open_recording(kitti_root, "08").mounting is None
    assert open_recording(kitti_root, "08", sensor_height=1.2).mounting == Mounting(1.2)
    asked = open_recording(kitti_root, "08", sensor_height="estimate")
    assert asked.mounting is None and "ground found in 0 of 3 scans (is z up in these files?)" in asked.found[-1]
    assert open_recording(bev_root, "06", sensor_height=1.2).mounting is None
    assert mounted(of_images({}), "estimate", known=False).mounting is None


@pytest.mark.parametrize("height", [0.6, MODEL_HEIGHT_M])
def test_another_sensor_in_kittis_layout_is_told(height, kitti_root):
    for path in (kitti_root / "sequences/08/velodyne").glob("*.bin"):
        points = street(0, height=height)
        np.column_stack([points, np.zeros(len(points))]).astype("<f4").tofile(path)
    for path in (kitti_root / "sequences/08/labels").glob("*.label"):
        np.zeros(2200, "<u4").tofile(path)
    if height == MODEL_HEIGHT_M:  # a warning is an error
        assert open_recording(kitti_root, "08").mounting is None
        return
    words = "sequence 08: expected the sensor 1.73 m above the ground, as its layout defines, found it 0.60 m"
    with pytest.warns(DataWarning, match=words):
        assert open_recording(kitti_root, "08").mounting is None
    assert open_recording(kitti_root, "08", sensor_height=height).mounting == Mounting(height)


@pytest.mark.slow
def test_real_scans(shared):
    """KITTI's sensor is 1.73 m above the road, nuScenes' 1.84 m above the one of its first scene."""
    data = shared / "data"
    kitti = [open_recording(data / "kitti_odometry", seq, sensor_height="estimate").mounting for seq in ("00", "08")]
    assert [round(found.height_m, 1) for found in kitti if found] == [1.8, 1.8]
    nuscenes = sglpr_jax.read_scan(data / "samples/nuscenes_32_beams.pcd.bin")
    assert abs(estimate_mounting(nuscenes).height_m - 1.84) < 0.15
