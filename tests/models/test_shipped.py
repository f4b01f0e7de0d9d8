"""Weights by name: those that ship with the package are whole and small, and describe images."""

import dataclasses
from pathlib import Path

import chex
import jax.numpy as jnp
import numpy as np
import pytest

from sglpr_jax.grid import Grid
from sglpr_jax.models import shipped
from sglpr_jax.models.backbone_config import SwinConfig
from sglpr_jax.models.config import HeadConfig, model_preset
from sglpr_jax.models.sglpr import describe
from sglpr_jax.models.shipped import shipped_weights, weights_folder
from sglpr_jax.models.weights import Params, for_places
from sglpr_jax.models.weights_file import CONFIG_FILE, WEIGHTS_FILE, load, save

FILES = ["README.md", CONFIG_FILE, WEIGHTS_FILE]
MAX_BYTES = 15e6
HEAD = HeadConfig(tap="tokens", channels=(16,), kernels=(4,), strides=(4,), cbam_reduction=4, clusters=4)
SWIN = SwinConfig(embed_dim=8, depths=(1,), heads=(2,), window=4, drop_path=0.1)
MODEL = dataclasses.replace(model_preset("tiny"), grid=Grid(3.2, 16, 16), backbone=SWIN, detail=8, head=HEAD)


def images_of(params: Params) -> jnp.ndarray:
    grid = params.config.grid
    return jnp.asarray(np.random.default_rng(0).poisson(0.3, (2, grid.height, grid.width)), jnp.float32)


@pytest.mark.slow
@pytest.mark.parametrize("name", shipped_weights())
def test_every_set_that_ships_is_whole_and_small_and_describes_images(name):
    folder = weights_folder(name)
    assert sorted(path.name for path in folder.iterdir()) == FILES
    assert max(path.stat().st_size for path in folder.iterdir()) <= MAX_BYTES
    params = load(folder)
    np.testing.assert_allclose(np.linalg.norm(describe(params, images_of(params)), axis=1), 1, rtol=1e-4)


@pytest.fixture(scope="module")
def params(random_params) -> Params:
    return random_params(MODEL)


def test_a_name_means_the_shipped_weights_and_a_path_a_folder(params, tmp_path, monkeypatch):
    monkeypatch.setattr(shipped, "FOLDER", tmp_path / "package")
    placeholder = save(for_places(params), shipped.FOLDER / "placeholder", half=True)
    assert shipped_weights() == ("placeholder",)
    monkeypatch.chdir(tmp_path)
    own = save(params, tmp_path / "placeholder")
    for name in ("placeholder", Path("placeholder")):
        assert weights_folder(name) == placeholder
        assert load(name).config.categories == 0
    for path in ("./placeholder", "placeholder/", str(own), own):
        assert load(path).config.categories == 20
    save(params, tmp_path / "other")
    chex.assert_trees_all_equal(load("other"), load(own))


def test_what_the_segmentation_head_alone_reads_is_dropped(params):
    places = for_places(params)
    assert set(params.weights) - set(places.weights) == {"segmentation_head", "narrow", "detail", "expand"}
    np.testing.assert_array_equal(describe(places, images_of(params)), describe(params, images_of(params)))
    assert for_places(places) is places
