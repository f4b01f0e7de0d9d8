"""Images of point counts against a numpy reference, exactly; images and points rotated, cut and put on even cells."""

import hypothesis
import hypothesis.extra.numpy as hnp
import hypothesis.strategies as st
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from sglpr_jax.bev import (
    centre_crop,
    count_outside,
    even_cells,
    rasterize,
    rasterize_labels,
    rotate_image,
    rotate_labels,
    rotate_points,
    uncrop_labels,
)
from sglpr_jax.grid import Grid

# At 0.26 m, 1 / r rounded once differs from the reciprocal of a rounded r, and from a division.
GRIDS = [Grid(), Grid(0.26, 96, 160), Grid(0.7, 2, 6)]
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


@pytest.mark.parametrize(
    "changed", [{"resolution_m": 0.0}, {"resolution_m": float("nan")}, {"height": 0}, {"width": 151}]
)
def test_a_grid_without_a_centre_is_refused(changed):
    with pytest.raises(ValueError, match=next(iter(changed)).removesuffix("_m")):
        Grid(**changed)


angles = st.floats(-10, 10, width=32)


@hypothesis.settings(deadline=None, max_examples=25)
@hypothesis.given(hnp.arrays(np.float32, (2, 5, 3), elements=st.floats(-100, 100, width=32)), st.tuples(angles, angles))
def test_points_rotate_as_in_numpy(points, turns):
    turns = np.float32(turns)
    found = rotate_points(points, turns)
    cos, sin = np.cos(turns.astype(np.float64)), np.sin(turns.astype(np.float64))
    for b in range(2):
        world_from_lidar = np.array([[cos[b], -sin[b], 0], [sin[b], cos[b], 0], [0, 0, 1]])
        np.testing.assert_allclose(found[b], points[b] @ world_from_lidar.T, atol=1e-4)
    np.testing.assert_array_equal(found[..., 2], points[..., 2])
    np.testing.assert_allclose(jax.vmap(rotate_points)(points, turns), found, atol=1e-5)


def bump(centre, size, resolution_m):
    """A smooth image in eq. 1's orientation: a Gaussian hill of 2 m at `centre` = (x, y)."""
    steps = (np.arange(size) - (size - 1) / 2) * resolution_m
    x, y = np.meshgrid(steps, -steps)
    return np.exp(-((x - centre[0]) ** 2 + (y - centre[1]) ** 2) / (2 * 2.0**2)).astype(np.float32)


@hypothesis.settings(deadline=None, max_examples=25)
@hypothesis.given(angles, st.floats(-6, 6), st.floats(-6, 6))
def test_images_rotate_as_their_points(angle, x, y):
    turned_centre = np.asarray(rotate_points(np.float32([[x, y, 0]]), np.float32(angle)))[0]
    found = rotate_image(bump((x, y), 64, 0.4), np.float32(angle))
    np.testing.assert_allclose(found, bump(turned_centre, 64, 0.4), atol=0.01)


def test_the_wide_middle_of_an_odd_image_becomes_two_cells_of_half_the_count():
    rng = np.random.default_rng(0)
    points = rng.uniform(-2.0, 2.0, (500, 2))
    wide, edges = np.trunc(points / 0.5).astype(int) + 3, np.arange(-2.0, 2.1, 0.5)
    image = np.zeros((2, 7, 7), np.float32)
    np.add.at(image, (0, 6 - wide[:, 1], wide[:, 0]), 1.0)  # as density images count: truncated, row against y
    found = np.asarray(even_cells(jnp.asarray(image)))
    assert found.shape == (2, 8, 8) and not found[1].any()
    counts = np.histogram2d(-points[:, 1], points[:, 0], [edges, edges])[0]  # the cells of eq. 1
    outer = [0, 1, 2, 5, 6, 7]
    np.testing.assert_array_equal(found[0][np.ix_(outer, outer)], counts[np.ix_(outer, outer)])
    np.testing.assert_array_equal(found[0, 3:5].sum(0)[outer], counts[3:5].sum(0)[outer])
    np.testing.assert_array_equal(found[0, 3], found[0, 4])
    assert found[0].sum() == 500
    np.testing.assert_array_equal(even_cells(jnp.asarray(found)), found)
    np.testing.assert_allclose(jax.jit(jax.vmap(even_cells))(jnp.asarray(image)), found)


def nearest_labels(labels, angle):
    """Each cell's label in a turned map by float64, and which cells lie too near to a cell's edge to tell."""
    height, width = labels.shape
    down, right = np.mgrid[:height, :width] - np.array([height - 1, width - 1])[:, None, None] / 2
    cos, sin = np.cos(float(angle)), np.sin(float(angle))
    source = np.stack([cos * down + sin * right + (height - 1) / 2, cos * right - sin * down + (width - 1) / 2])
    v, u = np.floor(source + 0.5).astype(int)
    inside = (v >= 0) & (v < height) & (u >= 0) & (u < width)
    found = np.where(inside, labels[v.clip(0, height - 1), u.clip(0, width - 1)], 0)
    return found, (np.abs(source % 1 - 0.5) < 1e-3).any(0)


@hypothesis.settings(deadline=None, max_examples=25)
@hypothesis.given(hnp.arrays(np.int32, (2, 7, 10), elements=st.integers(0, 34)), st.tuples(angles, angles))
def test_rotated_labels_are_those_of_the_nearest_cell(labels, turns):
    turns = np.float32(turns)
    found = np.asarray(rotate_labels(labels, turns))
    assert found.dtype == np.int32
    np.testing.assert_array_equal(jax.jit(jax.vmap(rotate_labels))(labels, turns), found)
    for b in range(2):
        expected, at_an_edge = nearest_labels(labels[b], turns[b])
        np.testing.assert_array_equal(np.where(at_an_edge, expected, found[b]), expected)


@pytest.mark.parametrize("shape, kept", [((4, 6), 16), ((5, 6), 12), ((5, 9), 9)])
def test_uncrop_labels_inverts_the_crop(shape, kept):
    labels = np.random.default_rng(0).integers(1, 20, shape).astype(np.int32)
    crop = np.array(centre_crop(even_cells(jnp.asarray(labels)), height=4, width=4))
    whole = uncrop_labels(crop, shape=shape)
    assert whole.shape == shape and (whole > 0).sum() == kept
    np.testing.assert_array_equal(whole, np.where(whole > 0, labels, 0))
    crop[1], crop[2] = 0, 7
    assert (uncrop_labels(crop, shape=shape)[shape[0] // 2] == 7).sum() == (shape[1] % 2 == 0) + 3


def test_the_centre_is_cropped():
    image = jnp.arange(2.0 * 5 * 7).reshape(2, 5, 7)
    np.testing.assert_array_equal(centre_crop(image, height=3, width=3), image[:, 1:4, 2:5])
    np.testing.assert_array_equal(centre_crop(image, height=4, width=7), image[:, :4, :])
    with pytest.raises(ValueError, match="6 x 3"):
        centre_crop(image, height=6, width=3)
