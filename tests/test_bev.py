"""Equation 1 against a numpy reference, exactly."""

import hypothesis
import hypothesis.extra.numpy as hnp
import hypothesis.strategies as st
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from sglpr_jax.bev import count_outside, rasterize, rasterize_labels
from sglpr_jax.data.formats.scan_files import read_scan
from sglpr_jax.data.readers.kitti import open_recording
from sglpr_jax.grid import Grid

# At 0.26 m, 1 / r rounded once differs from the reciprocal of a rounded r, and from a division.
GRIDS = [Grid(), Grid(0.1), Grid(0.4, 128, 128), Grid(0.26, 96, 160), Grid(0.7, 2, 6)]
SMALL = Grid(0.26, 10, 16)
CLOUD_SIZE = 32


def reference(points, grid, labels=None):
    """Equation 1 in numpy: image and semantic map of one cloud, and how many points lie outside.

    floor(x / r) is floor(x * (1 / r)) in float32, the reciprocal rounded once; |x| < 1e-30 counts as zero.
    """
    image = np.zeros((grid.height, grid.width), np.int32)
    semantic = np.zeros((grid.height, grid.width), np.int32)
    planar = np.where(np.abs(points[:, :2]) < 1e-30, np.float32(0), points[:, :2])
    with np.errstate(over="ignore"):
        cells = np.floor(planar * np.float32(1 / grid.resolution_m))
    for i, (point, (x, y)) in enumerate(zip(points, cells, strict=True)):
        if not np.isfinite(point).all():
            continue
        u, v = grid.width / 2 + x, grid.height / 2 - y - 1
        if 0 <= u < grid.width and 0 <= v < grid.height:
            image[int(v), int(u)] += 1
            semantic[int(v), int(u)] = 0 if labels is None else labels[i]
    return image, semantic, len(points) - image.sum()


def fast_reference(points, grid):
    """The image of `reference` for large clouds of finite points."""
    x, y = np.floor(points[:, :2] * np.float32(1 / grid.resolution_m)).astype(np.int64).T
    u, v = grid.width // 2 + x, grid.height // 2 - y - 1
    inside = (u >= 0) & (u < grid.width) & (v >= 0) & (v < grid.height)
    image = np.zeros((grid.height, grid.width), np.int32)
    np.add.at(image, (v[inside], u[inside]), 1)
    return image


def border_values(grid):
    """Every cell border of both axes as float32, and its two neighbours."""
    cells = np.arange(-grid.width // 2 - 1, grid.width // 2 + 2)
    borders = np.concatenate(
        [cells.astype(np.float32) * np.float32(grid.resolution_m), np.float32(cells * grid.resolution_m)]
    )
    return np.concatenate(
        [borders, np.nextafter(borders, np.float32(np.inf)), np.nextafter(borders, np.float32(-np.inf))]
    )


SPECIAL = [-0.0, 0.0, 1e-45, -1e-45, 1e-38, -1e-38, 9e-31, -9e-31, 2e-30, -2e-30, 3e38, -3e38, np.nan, np.inf, -np.inf]
coordinates = st.one_of(
    st.sampled_from([np.float32(value).item() for value in SPECIAL]),
    st.sampled_from(border_values(SMALL).tolist()),
    st.floats(-3, 3, width=32),
    st.floats(width=32),
)
clouds = hnp.arrays(np.float32, (CLOUD_SIZE, 3), elements=coordinates, fill=st.nothing())
labellings = hnp.arrays(np.int32, CLOUD_SIZE, elements=st.integers(0, 19))


@pytest.mark.slow
@hypothesis.settings(deadline=None, max_examples=100)
@hypothesis.given(clouds, labellings, st.integers(0, CLOUD_SIZE))
def test_any_cloud_equals_the_reference(points, labels, count):
    for used, given_count in ((CLOUD_SIZE, None), (count, jnp.int32(count))):
        image, semantic, outside = reference(points[:used], SMALL, labels[:used])
        np.testing.assert_array_equal(rasterize(points, grid=SMALL, count=given_count), image)
        np.testing.assert_array_equal(rasterize_labels(points, labels, grid=SMALL, count=given_count), semantic)
        assert count_outside(points, grid=SMALL, count=given_count) == outside


@pytest.mark.parametrize("grid", GRIDS)
def test_cell_borders_belong_to_the_cell_above(grid):
    values = border_values(grid)
    values = np.concatenate([values, np.float32(SPECIAL)])
    points = np.zeros((2 * len(values), 3), np.float32)
    points[: len(values), 0] = values
    points[len(values) :, 1] = values
    image, _, outside = reference(points, grid)
    np.testing.assert_array_equal(rasterize(points, grid=grid), image)
    with jax.disable_jit():
        np.testing.assert_array_equal(rasterize(jnp.asarray(points), grid=grid), image)
    assert count_outside(points, grid=grid) == outside


def test_the_axes_of_equation_1():
    grid = Grid(1.0, 4, 6)
    points = np.float32([[2.5, 0.5, 9], [0.5, 1.5, -9], [-3, -2, 0], [-0.0, -0.0, 0], [3, 0, 0], [0, 2, 0]])
    image = np.asarray(rasterize(points, grid=grid))
    expected = np.zeros((4, 6), np.int32)
    expected[1, 5] = 1  # far ahead: the last column
    expected[0, 3] = 1  # to the left: the first row
    expected[3, 0] = 1  # the window's lower corner is inside
    expected[1, 3] = 1  # the origin, whatever its sign
    np.testing.assert_array_equal(image, expected)
    assert image.dtype == np.int32
    assert count_outside(points, grid=grid) == 2  # the window's upper borders are outside


def test_the_last_point_gives_the_label():
    points = np.float32([[0.1, 0.1, 0], [5, 5, 0], [0.2, 0.2, 0]])
    image = rasterize_labels(points, np.int32([3, 4, 0]), grid=Grid(1.0, 2, 2))
    np.testing.assert_array_equal(image, np.zeros((2, 2)))
    image = rasterize_labels(points[::-1], np.int32([0, 4, 3]), grid=Grid(1.0, 2, 2))
    np.testing.assert_array_equal(image, [[0, 3], [0, 0]])


@pytest.mark.slow
def test_batches_vmap_jit_and_eager_agree():
    rng = np.random.default_rng(0)
    points = rng.uniform(-3, 3, (2, 3, CLOUD_SIZE, 3)).astype(np.float32)
    labels = rng.integers(0, 20, (2, 3, CLOUD_SIZE)).astype(np.int32)
    count = np.int32([[CLOUD_SIZE, 0, 1], [7, 20, 31]])

    def all_of(points, labels, count):
        return (
            rasterize(points, grid=SMALL, count=count),
            rasterize_labels(points, labels, grid=SMALL, count=count),
            count_outside(points, grid=SMALL, count=count),
        )

    expected = [
        [reference(points[b][: count[b]], SMALL, labels[b][: count[b]])[output] for b in np.ndindex(2, 3)]
        for output in range(3)
    ]
    batched = all_of(points, labels, count)
    mapped = jax.jit(jax.vmap(jax.vmap(all_of)))(points, labels, count)
    with jax.disable_jit():
        eager = all_of(jnp.asarray(points), jnp.asarray(labels), jnp.asarray(count))
    for results in (batched, mapped, eager):
        for found, wanted in zip(results, expected, strict=True):
            assert found.dtype == jnp.int32
            np.testing.assert_array_equal(found, np.reshape(wanted, found.shape))


def test_an_empty_cloud_is_an_empty_image():
    points, labels = np.zeros((2, 0, 3), np.float32), np.zeros((2, 0), np.int32)
    assert rasterize(points, grid=SMALL).shape == (2, 10, 16)
    assert not np.any(rasterize(points, grid=SMALL))
    np.testing.assert_array_equal(rasterize_labels(points, labels, grid=SMALL), np.zeros((2, 10, 16)))
    np.testing.assert_array_equal(count_outside(points, grid=SMALL), [0, 0])


@pytest.mark.parametrize(
    "changed", [{"resolution_m": 0.0}, {"resolution_m": float("nan")}, {"height": 0}, {"width": 151}]
)
def test_a_grid_without_a_centre_is_refused(changed):
    with pytest.raises(ValueError, match=next(iter(changed)).removesuffix("_m")):
        Grid(**changed)


@pytest.mark.slow
@pytest.mark.parametrize("grid", GRIDS)
def test_real_scans_equal_the_reference(shared, grid):
    samples = shared / "data/samples"
    scans = [read_scan(path) for path in sorted(samples.rglob("*.bin"))]
    for name in ("00", "08"):
        sequence = open_recording(shared / "data/kitti_odometry", name)
        scans += [sequence.points(i) for i in range(len(sequence))]
    assert len(scans) == 2 + 11 + 3
    counts = np.int32([len(points) for points in scans])
    padded = np.full((len(scans), counts.max(), 3), 0.05, np.float32)  # padding that would count if it were not masked
    for row, points in zip(padded, scans, strict=True):
        row[: len(points)] = points
    images = np.asarray(rasterize(padded, grid=grid, count=counts))
    for image, points in zip(images, scans, strict=True):
        np.testing.assert_array_equal(image, fast_reference(points, grid))
    np.testing.assert_array_equal(count_outside(padded, grid=grid, count=counts), counts - images.sum((1, 2)))


def test_a_real_scan_with_points_that_are_not_numbers(shared):
    points = read_scan(shared / "data/samples/16_beams.pcd")
    finite = points[np.isfinite(points).all(axis=1)]
    np.testing.assert_array_equal(rasterize(points, grid=Grid()), fast_reference(finite, Grid()))


@pytest.mark.slow
@pytest.mark.parametrize("grid", [Grid(), Grid(0.4, 128, 128)])
def test_real_labels_equal_the_reference(shared, grid):
    sequence = open_recording(shared / "data/kitti_odometry", "08")
    points, labels = sequence.points(1), sequence.labels(1)
    image, semantic, outside = reference(points, grid, labels)
    np.testing.assert_array_equal(rasterize(points, grid=grid), image)
    np.testing.assert_array_equal(rasterize_labels(points, labels, grid=grid), semantic)
    assert count_outside(points, grid=grid) == outside
