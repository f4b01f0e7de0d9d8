"""Hidden sectors: a wedge of each chosen image, at any bearing, and what the network is shown then."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from sglpr_jax.grid import Grid
from sglpr_jax.labels import UNLABELLED
from sglpr_jax.training.config import OcclusionConfig
from sglpr_jax.training.occlusion import visible
from sglpr_jax.training.step import _chunks

GRID = Grid(resolution_m=1.0, height=64, width=48)
IMAGES = 400


def bearings(grid):
    """Of each cell's centre, degrees, by complex numbers."""
    x, y = np.mgrid[: grid.height, : grid.width] + 0.5
    return np.rad2deg(np.angle((x - grid.height / 2) + 1j * (y - grid.width / 2))) % 360


def widths(hidden, grid):
    """The width of each image's hidden cells in degrees; they must be one sector, without a cell left inside."""
    bearing, group = np.unique(bearings(grid).round(3).ravel(), return_inverse=True)
    step = np.diff([*bearing, bearing[0] + 360])
    found = []
    for one in hidden:
        is_hidden = np.bincount(group, weights=one.ravel()) > 0
        assert (is_hidden != np.roll(is_hidden, 1)).sum() <= 2
        found.append(step[is_hidden].sum())
    return np.array(found)


@pytest.mark.parametrize("widest_deg", [60.0, 180.0, 270.0])
def test_a_sector_of_each_chosen_image_is_hidden(widest_deg):
    config = OcclusionConfig(share=0.5, widest_deg=widest_deg)
    shown = np.asarray(visible(jax.random.key(3), IMAGES, GRID, config))
    hidden_deg = widths(~shown, GRID)
    assert shown.shape == (IMAGES, 64, 48)
    chosen = hidden_deg > 1
    assert 0.4 < chosen.mean() < 0.6
    assert 0.9 * widest_deg < hidden_deg.max() < widest_deg + 2
    np.testing.assert_allclose(np.quantile(hidden_deg[chosen], [0.25, 0.75]) / widest_deg, [0.25, 0.75], atol=0.1)
    hidden_everywhere = (~shown[chosen]).mean(0)  # each bearing as often as the others
    assert np.ptp([hidden_everywhere[bearings(GRID) // 90 == quarter].mean() for quarter in range(4)]) < 0.12


def test_the_key_draws_it_also_under_jit_and_vmap():
    config = OcclusionConfig(share=0.5)
    drawn = jax.jit(lambda key: visible(key, 8, GRID, config))
    keys = jax.random.split(jax.random.key(0), 3)
    one_by_one = np.stack([visible(key, 8, GRID, config) for key in keys])
    np.testing.assert_array_equal(jax.vmap(drawn)(keys), one_by_one)
    assert (one_by_one[0] != one_by_one[1]).any()
    assert visible(keys[0], 8, GRID, OcclusionConfig(share=0.0)).all()
    assert (~visible(keys[0], 64, GRID, OcclusionConfig(share=1.0, widest_deg=360.0))).any((1, 2)).mean() > 0.95


def test_what_is_hidden_has_neither_counts_nor_labels(config, make_batch):
    batch = make_batch(0, images=True)
    batch = batch.replace(
        images=batch.images + 1, maps=np.ones(batch.images.shape, np.int32), labelled=np.ones(config.images, bool)
    )
    batch, config = jax.tree.map(jnp.asarray, batch), dataclasses.replace(config, rotate=False)
    angle_key, model_key = jax.random.split(jax.random.key(0))

    def chunk(occlusion):
        chunks = _chunks(batch, angle_key, model_key, dataclasses.replace(config, occlusion=occlusion))
        return np.asarray(chunks.images[0]), np.asarray(chunks.maps[0])

    whole, labels = chunk(OcclusionConfig())
    images, maps = chunk(OcclusionConfig(share=0.75))
    hidden = images == 0
    assert (whole > 0).all() and hidden.any((1, 2)).sum() >= 3 and not hidden.all((1, 2)).any()
    np.testing.assert_array_equal(images, np.where(hidden, 0, whole))
    np.testing.assert_array_equal(maps, np.where(hidden, UNLABELLED, labels))
    assert (labels != UNLABELLED).any()


@pytest.mark.parametrize(("field", "value"), [("share", 1.5), ("share", -0.1), ("widest_deg", 400.0)])
def test_what_cannot_be_is_refused(field, value):
    with pytest.raises(ValueError, match=f"OcclusionConfig.{field}: expected a number from 0 .* found {value}"):
        OcclusionConfig(**{field: value})
