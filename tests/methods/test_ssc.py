"""SSC: its cells, its alignment and its distance are those of its authors."""

import functools

import jax.numpy as jnp
import numpy as np
import pytest

from sglpr_jax.data.readers import open_recording
from sglpr_jax.labels import to_classes
from sglpr_jax.methods.handcrafted.ssc import NEWEST, PAPER, align, ssc, ssc_distance
from tests.methods import published_ssc as published

SETTINGS = {PAPER: {"rings": 50, "nearest": 0.0}, NEWEST: {"rings": 24, "nearest": 5.0}}
STRONGER = (0, 17, 9, 10, 11, 12, 15, 13, 14, 16, 18, 19)


def unpack(row, grid):
    """The classes of the fine cells (by ring and sector), and the outline."""
    ranks = row[:-720].astype(int)[:, None] // 16 ** np.arange(6) % 16
    return np.array(STRONGER)[ranks].reshape(-1, 1080), row[-720:].reshape(2, 360)


def fine_cells(points, classes, grid):
    sizes = {"rings": grid.fine_rings, "sectors": 1080, "farthest": grid.fine_rings * grid.fine_m}
    return published.cells_of(points.astype(float), classes, **sizes)


def fine_centres(scan, grid):
    """A point in the middle of every fine cell, of its class."""
    cells = fine_cells(*scan, grid)
    ring, sector = np.nonzero(cells)
    class_of = {priority: category for category, priority in published.PRIORITY.items()}
    places = (ring + 0.5) * grid.fine_m * np.exp(1j * (np.radians((sector + 0.5) / 3) - np.pi))
    return np.stack([places.real, places.imag], axis=1), np.array([class_of[p] for p in cells[ring, sector]])


@pytest.mark.parametrize("grid", [PAPER, NEWEST])
def test_the_descriptor_is_the_strongest_class_of_each_cell_and_the_outline(places, grid):
    rng = np.random.default_rng(0)
    random = rng.uniform(-55, 55, (3000, 3)).astype(np.float32), rng.integers(0, 20, 3000).astype(np.int32)
    assert grid.fine_rings * grid.fine_m >= 50 + 5 * np.sqrt(2)
    for points, classes in (places[0], random):
        row = ssc(points, classes, grid)
        assert row.shape == (grid.numbers,) and row.max() < 2**24
        found, outline = unpack(row, grid)
        cells = fine_cells(points, classes, grid)
        np.testing.assert_array_equal(np.vectorize(lambda c: published.PRIORITY.get(c, 0))(found), cells)
        np.testing.assert_allclose(outline, published.outline_of(points, classes), rtol=1e-6)


def chain(offsets):
    """Outlines of landmarks far apart from each other, of which the k-th is offsets[k] metres behind in x."""
    query, other = np.zeros((2, 2, 360), np.float32)
    for k, offset in enumerate(offsets):
        sector = 20 + 60 * k
        query[:, sector] = 20 * np.cos(np.radians(sector)), 20 * np.sin(np.radians(sector))
        other[:, sector] = query[:, sector] - [offset, 0]
    return query, other


@pytest.mark.parametrize(
    "offsets",
    [
        (2.0, 5.5),  # one is beyond the gate of 3 m, and stays there
        (2.0, 4.5),  # beyond it at first
        (2.0, 4.999, 6.499),  # joins so late that 20 steps do not end
        (2.9, 5.0, 6.9, 7.9),  # the move is larger than 5 m, and is given up
    ],
)
@pytest.mark.parametrize("sign", [1, -1])
def test_partners_within_three_metres_move_the_scan_step_by_step(offsets, sign):
    query, other = (np.float32(sign) * outline for outline in chain(offsets))
    expected = published.alignment(query.astype(float), other.astype(float))
    shift, move = align(jnp.asarray(query), jnp.asarray(other))
    assert int(shift) == expected[0] == 0 and expected[1].any() == (len(offsets) < 4)
    np.testing.assert_allclose(move, expected[1], atol=1e-4)


def outline(seed):
    rng = np.random.default_rng(seed)
    ranges = (rng.uniform(4, 30, 24).repeat(15) + rng.normal(0, 1, 360)) * (rng.random(360) < 0.7)
    angles = np.radians(np.arange(360) - 179.5)
    return np.stack([ranges * np.cos(angles), ranges * np.sin(angles)]).astype(np.float32)


@pytest.mark.parametrize("seed", range(2))
def test_outlines_are_aligned_as_published(seed):
    query = outline(seed)
    turned = published.rotate(np.roll(query, 100 + seed, axis=1), 100 + seed)
    for other in (outline(seed + 100), (turned + [[1.2], [-0.8]] * turned.any(axis=0)).astype(np.float32)):
        shift, move = align(jnp.asarray(query), jnp.asarray(other))
        expected = published.alignment(query.astype(float), other.astype(float))
        assert int(shift) == expected[0]
        np.testing.assert_allclose(move, expected[1], atol=1e-3)


@pytest.mark.slow
@pytest.mark.parametrize("grid", [PAPER, NEWEST])
def test_the_distance_is_the_published_one_of_the_middles_of_the_fine_cells(places, turn_points, grid):
    points, classes = places[0]
    scans = [
        (points, classes),
        (turn_points(points + np.float32([1.2, -0.7, 0]), 2.5), classes),
        (turn_points(points, np.radians(77)), classes),
        places[1],
    ]
    rows = np.stack([ssc(*scan, grid) for scan in scans])
    found = ssc_distance(rows[:1], rows, grid)[0]
    kept = functools.partial(fine_centres, grid=grid)
    expected = [published.distance(scans[0], scan, **SETTINGS[grid], moved=kept) for scan in scans]
    np.testing.assert_allclose(found, expected, atol=2e-3)
    assert found[0] == 0
    assert found[1] < found[3] - 0.2


@pytest.mark.slow
@pytest.mark.parametrize(
    ("grid", "distances"),
    # Of a port of the authors' code to the three pairs: 24 rings from 5 m, and the paper's 50 from the sensor.
    [(NEWEST, (0.424, 0.220, 0.850)), (PAPER, (0.464, 0.313, 0.846))],
)
def test_real_pairs_are_as_far_apart_as_by_the_authors_code(shared, grid, distances):
    pairs = (("00", 52, 4501), ("08", 720, 1500), ("00", 88, 850))
    for (name, *frames), distance in zip(pairs, distances, strict=True):
        recording = open_recording(shared / "data/kitti_odometry", name)
        rows = [recording.ids.index(f"{frame:06d}") for frame in frames]
        scans = [(recording.points(row), to_classes(recording.labels(row))) for row in rows]
        assert published.distance(*scans, **SETTINGS[grid]) == pytest.approx(distance, abs=5e-4)
        here, there = (ssc(*scan, grid)[None] for scan in scans)
        assert ssc_distance(here, there, grid)[0, 0] == pytest.approx(distance, abs=0.01)


@pytest.mark.parametrize("classes", [np.zeros(40), np.full(40, 1), np.full(40, 9)])
def test_scans_without_landmarks_can_be_compared(classes):
    points = np.random.default_rng(0).uniform(-30, 30, (40, 3)).astype(np.float32)
    row = ssc(points, classes.astype(np.int32))[None]
    # Classes that move or have no label leave nothing to compare; road is compared without being aligned.
    np.testing.assert_array_equal(ssc_distance(row, row), [[0.0 if classes[0] == 9 else 1.0]])


def test_rows_of_other_rings_are_refused():
    rows = np.zeros((2, NEWEST.numbers), np.float32)
    with pytest.raises(ValueError, match=r"expected descriptors of 31680 numbers \(50 rings\), found 17280"):
        ssc_distance(rows, rows)
