"""Every handcrafted method against its definition, under rotations, and on real scans."""

import numpy as np
import pytest

from sglpr_jax.bev import rotate_image
from sglpr_jax.data.readers import open_recording
from sglpr_jax.labels import to_classes
from sglpr_jax.methods.handcrafted import HANDCRAFTED
from sglpr_jax.methods.handcrafted.m2dp import signature
from sglpr_jax.methods.handcrafted.polar_fft import polar_fft
from sglpr_jax.methods.handcrafted.ring import ring
from sglpr_jax.methods.names import HANDCRAFTED_NAMES
from sglpr_jax.retrieval.distances import DISTANCES

from . import handcrafted_reference as reference

ON_POINTS = [name for name, method in HANDCRAFTED.items() if method.takes != "images"]
ALIGNED = [name for name, method in HANDCRAFTED.items() if method.distance is not None]
DESCRIPTORS = {"lidar-iris": reference.lidar_iris, "probe": reference.probe, "scan-context": reference.scan_context}
DESCRIPTORS |= {"ring": reference.ring, "solid": reference.solid}
FORMULAS = {"probe": reference.probe_distance, "ring": reference.ring_distance}
FORMULAS |= {"scan-context": reference.scan_context_distance}
COLUMNS = {"lidar-iris": 360, "probe": 60, "scan-context": 60}


def describe(name, points, classes):
    method = HANDCRAFTED[name]
    return method.describe(points, classes) if method.takes == "labelled points" else method.describe(points)


def compare(name, a, b):
    return DISTANCES[HANDCRAFTED[name].distance_name](a, b)


def test_the_table_has_all_names():
    assert tuple(HANDCRAFTED) == HANDCRAFTED_NAMES
    assert all(method.source and method.distance_name in DISTANCES for method in HANDCRAFTED.values())


@pytest.mark.parametrize("name", DESCRIPTORS)
def test_the_descriptor_is_that_of_its_definition(places, wide, name):
    for points, classes in (places[0], wide):
        expected = DESCRIPTORS[name](points).ravel()
        np.testing.assert_allclose(describe(name, points, classes), expected, rtol=1e-5, atol=1e-5)


def test_m2dp_is_the_papers():
    points = (np.random.default_rng(0).gamma(2.0, 1.0, (150, 3)) * [9, 4, 1]).astype(np.float32)
    np.testing.assert_allclose(signature(points), reference.m2dp_signature(points), atol=1e-9)
    np.testing.assert_allclose(describe("m2dp", points, None), reference.m2dp(points), atol=1e-4)


@pytest.mark.parametrize("radius", [None, 7.5])
def test_polar_fft_is_that_of_its_definition(radius):
    images = np.random.default_rng(0).integers(0, 5, (2, 20, 31)).astype(np.float32)
    expected = np.stack([reference.polar_fft(image, radius or 10) for image in images])
    np.testing.assert_allclose(polar_fft(images, radius=radius), expected, atol=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize("name", FORMULAS)
def test_the_distance_is_its_formula(places, name):
    rows = np.stack([describe(name, *place) for place in places[:3]])
    if name == "scan-context":  # with empty columns, of which each pair shares others
        rows = (rows.reshape(3, 20, 60) * (np.random.default_rng(2).random((3, 1, 60)) < 0.4)).reshape(3, -1)
    expected = [[FORMULAS[name](a, b) for b in rows] for a in rows[:2]]
    np.testing.assert_allclose(compare(name, rows[:2], rows), expected, atol=1e-5)


@pytest.mark.parametrize("name", COLUMNS)
def test_whole_columns_of_turn_change_nothing(places, name):
    rows = np.stack([describe(name, *place) for place in places])
    images = rows.reshape(len(rows), -1, COLUMNS[name])
    turned = np.roll(images, 17, axis=2).reshape(rows.shape)
    atol = 5e-3 if name == "lidar-iris" else 1e-4
    np.testing.assert_allclose(compare(name, turned, rows), compare(name, rows, rows), atol=atol)


@pytest.mark.parametrize("name", ON_POINTS)
def test_a_turned_scan_is_much_nearer_than_another_place(places, turn_points, name):
    rows = np.stack([describe(name, *place) for place in places])
    between = compare(name, rows, rows)[~np.eye(len(rows), dtype=bool)]
    for angle in (0.4, np.pi):
        turned = np.stack([describe(name, turn_points(points, angle), classes) for points, classes in places])
        assert np.diag(compare(name, turned, rows)).max() < 0.35 * between.min()


def test_turned_images_are_nearer_than_other_places():
    rng = np.random.default_rng(0)
    down, right = np.mgrid[-32:33, -32:33]
    centres = rng.uniform(-20, 20, (4, 12, 2, 1, 1))
    images = 10 * np.exp(-((down - centres[:, :, 0]) ** 2 + (right - centres[:, :, 1]) ** 2) / 8).sum(1)
    images = (images * (np.hypot(down, right) < 31)).astype(np.float32)
    here = polar_fft(images)
    turned = polar_fft(np.asarray(rotate_image(images, np.full(4, 2.5, np.float32))))
    moved, between = (np.linalg.norm(other - here, axis=1).mean() for other in (turned, here[[1, 2, 3, 0]]))
    assert moved < 0.25 * between
    even = images[:, 1:, 1:]  # the middle pixel of an odd image stays in its sector
    np.testing.assert_allclose(polar_fft(np.rot90(even, axes=(1, 2))), polar_fft(even), atol=1e-6)


def test_m2dp_ignores_any_rigid_motion_and_ring_a_translation(places):
    points = places[0][0].astype(np.float64)
    turn, _ = np.linalg.qr(np.random.default_rng(0).normal(size=(3, 3)))
    moved = (points @ (turn * np.sign(np.linalg.det(turn))).T + [3.0, -5.0, 1.0]).astype(np.float32)
    assert np.linalg.norm(describe("m2dp", moved, None) - describe("m2dp", places[0][0], None)) < 1e-3
    near = np.column_stack([np.random.default_rng(0).uniform(-30, 30, (300, 2)), np.zeros(300)]).astype(np.float32)
    by_cells = near + np.array([7 * 7 / 6, -4 * 7 / 6, 0], np.float32)
    assert compare("ring", ring(near)[None], ring(by_cells)[None])[0, 0] < 2e-3


@pytest.mark.parametrize("name", ON_POINTS)
def test_an_empty_scan_has_zeros_and_the_order_of_points_does_not_matter(places, name):
    empty = describe(name, np.zeros((0, 3), np.float32), np.zeros(0, np.int32))
    assert empty.dtype == np.float32 and not empty.any()
    points, classes = places[0]
    found = describe(name, points, classes)
    if name in ALIGNED:
        np.testing.assert_array_equal(compare(name, empty[None], found[None]), 1)
    if not name.startswith("ssc"):  # its outlines keep the last landmark of a sector
        order = np.random.default_rng(0).permutation(len(points))
        np.testing.assert_allclose(describe(name, points[order], classes[order]), found, atol=1e-5)


@pytest.mark.parametrize("name", ON_POINTS)
@pytest.mark.parametrize("points", [np.zeros((1, 3)), np.ones((5, 3)), np.eye(3)], ids=["one", "equal", "three"])
def test_clouds_without_extent_have_descriptors(name, points):
    assert np.isfinite(describe(name, points.astype(np.float32), np.full(len(points), 9, np.int32))).all()


@pytest.fixture(scope="module")
def real(shared):
    """Return points and classes of real scans by sequence and frame."""
    scans = {}
    for name, frames in (("00", (52, 88, 850, 4501)), ("08", (720, 1500))):
        sequence = open_recording(shared / "data" / "kitti_odometry", name)
        for frame in frames:
            row = sequence.ids.index(f"{frame:06d}")
            scans[name, frame] = sequence.points(row), to_classes(sequence.labels(row))
    return scans


@pytest.mark.slow
@pytest.mark.parametrize("name", ON_POINTS)
def test_real_loops_rank_above_a_pair_that_is_none(real, name):
    rows = {scan: describe(name, *content)[None] for scan, content in real.items()}
    none = compare(name, rows["00", 88], rows["00", 850])[0, 0]
    assert compare(name, rows["00", 52], rows["00", 4501])[0, 0] < none
    assert compare(name, rows["08", 720], rows["08", 1500])[0, 0] < none  # driven in the opposite direction
