"""The polar image is a bilinear reading of the Cartesian one, in which a rotation is a shift."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.ndimage import gaussian_filter, map_coordinates

from sglpr_jax.bev import rotate_image
from sglpr_jax.grid import Grid
from sglpr_jax.models.input_image import from_polar, to_polar

GRID = Grid(resolution_m=1.0, height=32, width=40)
RADIUS = 16
RINGS, SECTORS = 16, 96


def radius_of_cells() -> np.ndarray:
    down, right = np.mgrid[: GRID.height, : GRID.width]
    return np.hypot(down - (GRID.height - 1) / 2, right - (GRID.width - 1) / 2)


@pytest.fixture(scope="module")
def images():
    """Two images of two channels, smooth, and zero near the border so that a rotation loses nothing."""
    noise = np.random.default_rng(0).normal(size=(2, GRID.height, GRID.width, 2))
    smooth = gaussian_filter(noise, (0, 3, 3, 0))
    fade = np.clip((RADIUS - 2 - radius_of_cells()) / 4, 0, 1)[None, :, :, None]
    return jnp.asarray(smooth * fade / np.abs(smooth).max(), jnp.float32)


def test_the_polar_image_is_scipys(images):
    ring, sector = np.mgrid[:RINGS, :SECTORS] + 0.5
    radius, angle = ring * RADIUS / RINGS, sector * 2 * np.pi / SECTORS
    row = (GRID.height - 1) / 2 - radius * np.sin(angle)  # y, to the left, is up
    column = (GRID.width - 1) / 2 + radius * np.cos(angle)  # x, forward, is to the right
    found = to_polar(images, GRID, RINGS, SECTORS)
    assert found.shape == (2, RINGS, SECTORS, 2)
    for b in range(2):
        for c in range(2):
            expected = map_coordinates(np.asarray(images[b, ..., c]), [row, column], order=1, mode="nearest")
            np.testing.assert_allclose(found[b, ..., c], expected, atol=1e-5)


def test_the_way_back_is_scipys(images):
    polar = to_polar(images, GRID, RINGS, SECTORS)
    up = (GRID.height - 1) / 2 - np.mgrid[: GRID.height, : GRID.width][0]
    right = np.mgrid[: GRID.height, : GRID.width][1] - (GRID.width - 1) / 2
    ring = np.clip(np.hypot(up, right) * RINGS / RADIUS - 0.5, 0, RINGS - 1)
    sector = (np.arctan2(up, right) % (2 * np.pi)) * SECTORS / (2 * np.pi) - 0.5
    around = np.pad(np.asarray(polar), ((0, 0), (0, 0), (1, 1), (0, 0)), mode="wrap")
    found = from_polar(polar, GRID)
    assert found.shape == images.shape
    expected = map_coordinates(around[1, ..., 0], [ring, sector + 1], order=1, mode="nearest")
    np.testing.assert_allclose(found[1, ..., 0], expected * (radius_of_cells() < RADIUS), atol=1e-5)


@pytest.mark.parametrize("sectors_turned", [8, 24, 41, 88])
def test_a_rotation_of_the_image_is_a_shift_of_its_polar_form(images, sectors_turned):
    planes = jnp.moveaxis(images, -1, 1)
    angle = jnp.full(planes.shape[:2], sectors_turned * 2 * np.pi / SECTORS, jnp.float32)
    turned = jnp.moveaxis(rotate_image(planes, angle), 1, -1)
    shifted = np.roll(to_polar(images, GRID, RINGS, SECTORS), sectors_turned, axis=2)
    difference = np.abs(to_polar(turned, GRID, RINGS, SECTORS) - shifted)
    assert difference.max() < 0.05  # of an image whose largest value is about 1: two bilinear readings
    assert difference.max() < 0.2 * np.abs(shifted - to_polar(images, GRID, RINGS, SECTORS)).max()


def there(image):
    return to_polar(image, GRID, RINGS, SECTORS)


def and_back(polar):
    return from_polar(polar, GRID)


@pytest.mark.parametrize("resample", [there, and_back])
def test_jit_vmap_and_the_gradient_agree(resample, images):
    image = images if resample is there else there(images)
    expected = resample(image)
    np.testing.assert_allclose(jax.jit(resample)(image), expected, atol=1e-6)
    np.testing.assert_allclose(jax.vmap(resample)(image[:, None])[:, 0], expected, atol=1e-6)
    # The map is linear, so its gradient is its transpose: <map(x), y> = <x, gradient at y>, for any x and y.
    keys = jax.random.split(jax.random.key(1))
    x, y = jax.random.normal(keys[0], image.shape), jax.random.normal(keys[1], expected.shape)
    gradient = jax.jit(lambda y: jax.vjp(resample, image)[1](y)[0])
    np.testing.assert_allclose((resample(x) * y).sum(), (x * gradient(y)).sum(), rtol=1e-4, atol=1e-3)
    each = jax.vmap(lambda i, y: jax.vjp(resample, i)[1](y)[0])(image[:, None], y[:, None])
    np.testing.assert_allclose(each[:, 0], gradient(y), atol=1e-5)
