"""What all methods on points have in common, and what they make of real scans."""

import numpy as np
import pytest

from sglpr_jax.data.readers import open_recording
from sglpr_jax.labels import to_classes
from sglpr_jax.methods.handcrafted import HANDCRAFTED
from sglpr_jax.methods.handcrafted.m2dp import m2dp
from sglpr_jax.methods.handcrafted.solid import solid
from sglpr_jax.retrieval.distances import distance_function

ON_POINTS = [name for name, method in HANDCRAFTED.items() if method.takes != "images"]
ANGLES = (0.4, np.pi)


def describe(name, points, classes):
    method = HANDCRAFTED[name]
    return method.describe(points, classes) if method.takes == "labelled points" else method.describe(points)


def compare(name, a, b):
    return distance_function(HANDCRAFTED[name].distance_name)(a, b)


@pytest.mark.parametrize(
    ("method", "angle"),
    # SOLiD thins the points on a square grid, which only quarter turns carry onto itself.
    [(m2dp, 0.4), (m2dp, 5.01), (solid, np.pi / 2), (solid, np.pi)],
)
def test_a_turn_hardly_changes_descriptors_that_are_invariant(places, turn_points, method, angle):
    for points, _ in places:
        assert np.linalg.norm(method(turn_points(points, angle)) - method(points)) < 0.02


@pytest.mark.parametrize("name", ON_POINTS)
def test_a_turned_scan_is_much_nearer_than_another_place(places, turn_points, name):
    rows = np.stack([describe(name, *place) for place in places])
    between = compare(name, rows, rows)[~np.eye(len(rows), dtype=bool)]
    for angle in ANGLES:
        turned = np.stack([describe(name, turn_points(points, angle), classes) for points, classes in places])
        assert np.diag(compare(name, turned, rows)).max() < 0.35 * between.min()


@pytest.mark.parametrize("name", ON_POINTS)
def test_an_empty_scan_has_a_descriptor_of_zeros(name):
    found = describe(name, np.zeros((0, 3), np.float32), np.zeros(0, np.int32))
    assert found.dtype == np.float32 and not found.any()


# SSC's outlines keep the last landmark of a sector.
@pytest.mark.parametrize("name", [name for name in ON_POINTS if not name.startswith("ssc")])
def test_the_order_of_the_points_does_not_matter(places, name):
    points, classes = places[0]
    order = np.random.default_rng(0).permutation(len(points))
    np.testing.assert_allclose(
        describe(name, points[order], classes[order]), describe(name, points, classes), atol=1e-5
    )


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

    def apart(sequence, a, b):
        return compare(name, rows[sequence, a], rows[sequence, b])[0, 0]

    none = apart("00", 88, 850)
    assert apart("00", 52, 4501) < none
    assert apart("08", 720, 1500) < none  # driven in the opposite direction
