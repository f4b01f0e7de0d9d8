"""Heat maps of every kind of model: those that its backbone and its place head name."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from sglpr_jax.grid import Grid
from sglpr_jax.models.config import MODELS, HeadConfig, SwinConfig, model_preset
from sglpr_jax.models.sglpr import forward, init
from sglpr_jax.models.shipped import shipped_weights
from sglpr_jax.models.weights_file import load
from sglpr_jax.retrieval.heat_maps import heat_maps

HEAD = HeadConfig(channels=(16,), kernels=(4,), strides=(4,), cbam_reduction=4, clusters=4)
CONFIG = dataclasses.replace(
    model_preset("tiny"),
    grid=Grid(resolution_m=1.0, height=16, width=16),
    backbone=SwinConfig(embed_dim=8, depths=(1,), heads=(2,), window=4, drop_path=0.1),
    head=HEAD,
)


@pytest.mark.slow
@pytest.mark.parametrize("polar", [None, (8, 32)])
def test_maps_lie_on_the_grid_of_the_image_and_follow_it(random_params, polar):
    params = random_params(dataclasses.replace(CONFIG, polar=polar, field="circle"))
    image = np.zeros((16, 16), np.int32)
    image[2:6, 7:12] = 5
    found, other = heat_maps(params, image), heat_maps(params, image[::-1].copy())
    assert list(found) == ["encoder, first", "encoder, last", "decoder", "CBAM"]
    for name, values in found.items():
        assert values.shape == (16, 16)
        assert np.isnan(values[0, 0]) and np.isfinite(values[4, 8])
        assert (np.nanmin(values), np.nanmax(values)) == (0, 1)
        assert np.nanmax(np.abs(values - other[name])) > 0.1


@pytest.mark.slow
@pytest.mark.parametrize("preset", MODELS)
def test_the_maps_that_a_preset_names_are_there_and_have_the_form_of_its_image(preset):
    """Traced only, so that the paper's sizes cost nothing."""
    config = model_preset(preset)
    shape = (1, config.grid.height, config.grid.width)
    params = jax.eval_shape(lambda: init(jax.random.key(0), config=config))
    maps = jax.eval_shape(lambda p, x: forward(p, x, segment=0), params, jnp.zeros(shape)).intermediates
    height, width = config.image_size
    for title, name in config.pictures.items():
        _, rows, columns, _ = maps[name].shape
        assert height % rows == 0 and width % columns == 0, title


@pytest.mark.slow
@pytest.mark.parametrize("name", ["tiny", *shipped_weights()])
def test_a_square_and_a_polar_preset_and_every_shipped_weight_have_pictures(name, random_params):
    params = load(name) if name in shipped_weights() else random_params(model_preset(name))
    grid = params.config.grid
    found = heat_maps(params, np.random.default_rng(0).poisson(0.3, (grid.height, grid.width)).astype(np.float32))
    assert len(found) >= 3
    for title, values in found.items():
        assert values.shape == (grid.height, grid.width)
        assert (np.nanmin(values), np.nanmax(values)) == (0, 1), title


def test_a_head_without_a_backbone_shows_its_own_maps_or_what_it_reads(random_params):
    """Table 6, with and without CBAM and convolutions."""
    bare = dataclasses.replace(HEAD, input="counts", cbam=False)
    none = dataclasses.replace(bare, tap="tokens", channels=(), kernels=(), strides=())
    titles = {
        "CBAM": dataclasses.replace(HEAD, input="counts"),
        "place head, first": bare,
        "input of the place head": none,
    }
    for title, head in titles.items():
        params = random_params(dataclasses.replace(CONFIG, head=head))
        assert list(heat_maps(params, np.arange(256).reshape(16, 16))) == [title]
