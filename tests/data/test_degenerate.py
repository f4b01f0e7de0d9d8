"""Scans and images that show no place are refused or skipped by embedding and by the model."""

import dataclasses
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from recordings import of_images, of_scans

import sglpr_jax
from sglpr_jax.grid import Grid
from sglpr_jax.models.config import model_preset

GOOD = np.random.default_rng(0).uniform(-15, 15, (400, 3)).astype(np.float32)
FAR = GOOD + np.float32([200, 0, 0])
CONFIG = model_preset("tiny")


def recording(*clouds):
    return of_scans({Path(f"{i}.bin"): cloud for i, cloud in enumerate(clouds)}, positions=np.zeros((len(clouds), 3)))


def test_embedding_refuses_an_empty_window_and_an_empty_image(random_params):
    scans = recording(GOOD, FAR)
    params = random_params(CONFIG)
    with pytest.raises(ValueError, match="scan 1 of sequence 08: expected points in at least 2 cells"):
        sglpr_jax.embed(params, scans)
    blank = np.zeros((CONFIG.grid.height, CONFIG.grid.width), np.float32)
    with pytest.raises(ValueError, match=r"scan 0 of sequence 08: expected points in at least 2 cells .* in 0"):
        sglpr_jax.embed(params, of_images({Path("0.png"): blank}))


def test_the_flag_beside_the_descriptor(random_params):
    config = dataclasses.replace(CONFIG, blind_m=2.0)
    params, (height, width) = random_params(config), (config.grid.height, config.grid.width)
    empty, good, near, broken = np.zeros((4, height, width), np.float32)
    good[3, 4:6] = 1
    near[height // 2, width // 2 - 1 : width // 2 + 1] = 9  # under the vehicle, where the model does not look
    broken[3, 4:6], broken[0, 0] = 1, np.nan
    images = jnp.stack([empty, good, near, broken])
    expected = [False, True, False, False]
    np.testing.assert_array_equal(sglpr_jax.is_describable(params, images), expected)
    one_by_one = jax.jit(jax.vmap(sglpr_jax.is_describable, in_axes=(None, 0)))(params, images.astype(jnp.int32))
    np.testing.assert_array_equal(one_by_one, [False, True, False, True])  # integers know no NaN


@pytest.mark.slow
def test_integers_are_no_density_image_but_its_bytes_are(random_params):
    config = dataclasses.replace(CONFIG, grid=Grid(0.4, CONFIG.grid.height, CONFIG.grid.width), image="density")
    params = random_params(config)
    grey = np.random.default_rng(0).integers(0, 256, (config.grid.height, config.grid.width)).astype(np.uint8)
    counts = grey * np.float32(10 / 255)
    np.testing.assert_array_equal(sglpr_jax.describe(params, grey), sglpr_jax.describe(params, counts))
    for other in (np.int32, np.int16, np.uint16):
        with pytest.raises(ValueError, match=f"expected counts 0 to 10 as floats, .* found {other.__name__}"):
            sglpr_jax.describe(params, counts.astype(other))
