"""What the Swin-Unet promises beyond its numbers: purity, stochastic depth, transformations, clear errors."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.extend.core import jaxprs_in_params

from sglpr_jax.models.layers import LayerNorm
from sglpr_jax.models.swin import DropPath, PatchEmbed, SwinBlock, WindowAttention
from sglpr_jax.models.swin_unet import SwinUnet, drop_path_rates

MODEL = SwinUnet(embed_dim=8, depths=(2, 2), heads=(1, 2), window=4, drop_path=0.5)


@pytest.fixture(scope="module")
def images():
    return jnp.asarray(np.random.default_rng(0).poisson(0.5, size=(3, 32, 32, 1)), jnp.float32)


@pytest.fixture(scope="module")
def variables(random_variables, images):
    return random_variables(MODEL, images)


@pytest.fixture(scope="module")
def tokens(variables, images):
    return jax.jit(MODEL.apply)(variables, images)[0]


def test_jit_vmap_and_single_images_agree_with_the_batch(variables, images, tokens):
    def apply(x):
        return MODEL.apply(variables, x)[0]

    assert tokens.shape == (3, 8, 8, 8)
    np.testing.assert_allclose(jax.jit(jax.vmap(apply))(images[:, None])[:, 0], tokens, atol=2e-5)
    np.testing.assert_allclose(jax.jit(apply)(images[1:2]), tokens[1:2], atol=2e-5)


def test_no_array_of_the_model_has_a_rank_above_five(variables, images):
    ranks = []
    for equation in all_equations(jax.make_jaxpr(jax.grad(lambda v: MODEL.apply(v, images)[0].sum()))(variables).jaxpr):
        ranks += [value.aval.ndim for value in equation.outvars]
    assert max(ranks) <= 5


def all_equations(jaxpr):
    for equation in jaxpr.eqns:
        yield equation
        for inner in jaxprs_in_params(equation.params):
            yield from all_equations(inner)


def test_stochastic_depth_follows_its_key_and_is_off_outside_training(variables, images, tokens):
    @jax.jit
    def train(key):
        return MODEL.apply(variables, images, train=True, rngs={"drop_path": key})[0]

    first, again, other = (train(jax.random.key(seed)) for seed in (0, 0, 1))
    np.testing.assert_array_equal(first, again)
    assert np.abs(first - other).max() > 1e-3
    assert np.abs(first - tokens).max() > 1e-3


@pytest.mark.slow
@pytest.mark.parametrize("height, down", [(4, 0), (8, 2)])
def test_windows_are_shifted_in_each_direction_that_is_larger_than_them(height, down, random_variables):
    """Against windows gathered token by token, in a circular map; a row may not see one that was rolled in."""
    x = jnp.asarray(np.random.default_rng(0).normal(size=(1, height, 12, 8)), jnp.float32)
    block = SwinBlock(heads=2, window=4, shifted=True, circular=True, shift_each_way=True)
    variables = random_variables(block, x)
    normed = LayerNorm().apply({"params": variables["params"]["attention_norm"]}, x)[0]
    attention = {"params": variables["params"]["attention"]}
    expected = np.zeros(normed.shape, np.float32)
    for top, left in np.ndindex(height // 4, 3):
        rows = (np.arange(4) + 4 * top + down) % height
        columns = (np.arange(4) + 4 * left + 2) % 12
        tokens = np.ix_(rows, columns)
        apart = np.repeat(np.abs(rows[:, None] - rows[None]) > 4, 4, 0).repeat(4, 1)
        found = WindowAttention(heads=2).apply(attention, normed[tokens].reshape(1, 16, 8), apart[None])
        expected[tokens] = np.reshape(found, (4, 4, 8))
    middle = x[0] + expected
    whole = middle + block_mlp(variables["params"], middle)
    np.testing.assert_allclose(block.apply(variables, x)[0], whole, atol=1e-4)


def block_mlp(params, x):
    """The second branch of a block, from its weights."""
    normed = np.asarray(LayerNorm().apply({"params": params["mlp_norm"]}, x))
    hidden = jax.nn.gelu(normed @ params["mlp_in"]["kernel"] + params["mlp_in"]["bias"][None, None], approximate=False)
    return np.asarray(hidden) @ params["mlp_out"]["kernel"] + params["mlp_out"]["bias"][None, None]


def test_without_the_option_a_map_that_a_window_spans_is_not_shifted(random_variables):
    x = jnp.asarray(np.random.default_rng(0).normal(size=(1, 4, 12, 8)), jnp.float32)
    options = {"heads": 2, "window": 4, "circular": True}
    variables = random_variables(SwinBlock(shifted=True, **options), x)
    shifted, straight = (SwinBlock(shifted=shifted, **options).apply(variables, x) for shifted in (True, False))
    np.testing.assert_array_equal(shifted, straight)


def test_both_branches_of_a_block_are_dropped_per_sample_and_independently(random_variables):
    block = SwinBlock(heads=1, window=4, shifted=False, drop_path=0.5)
    image = jnp.broadcast_to(jnp.asarray(np.random.default_rng(0).normal(size=(4, 4, 8)), jnp.float32), (64, 4, 4, 8))
    variables = random_variables(block, image)
    out = block.apply(variables, image, train=True, rngs={"drop_path": jax.random.key(1)})
    kinds = np.unique(np.round(np.asarray(out - image).reshape(64, -1), 4), axis=0)
    assert len(kinds) == 4  # neither branch, only the first, only the second, both


def test_kept_branches_are_scaled_so_that_the_mean_stays():
    branch = jnp.ones((4096, 1, 1, 1))
    out = DropPath(0.25).apply({}, branch, train=True, rngs={"drop_path": jax.random.key(0)})
    np.testing.assert_allclose(np.unique(out), [0, 1 / 0.75], rtol=1e-6)
    assert abs(float(out.mean()) - 1) < 0.05


def test_drop_path_rates_rise_to_the_last_encoder_block(golden):
    rates = np.concatenate(drop_path_rates((2, 2, 2, 2), 0.2))
    np.testing.assert_allclose(rates, golden("tables_masks")["drop_path_full"], atol=1e-7)


@pytest.mark.slow
def test_an_empty_image_has_finite_gradients(variables, images):
    gradients = jax.jit(jax.grad(lambda v: MODEL.apply(v, jnp.zeros_like(images))[0].var()))(variables)
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(gradients))


@pytest.mark.slow
def test_initial_weights_are_the_references(images):
    block = SwinBlock(heads=2, window=4, shifted=True).init(jax.random.key(0), jnp.zeros((1, 8, 8, 16)))["params"]
    kernel = PatchEmbed(channels=8).init(jax.random.key(0), images)["params"]["projection"]["kernel"]
    np.testing.assert_allclose(np.std(block["mlp_in"]["kernel"]), 0.02, rtol=0.1)
    np.testing.assert_allclose(np.std(block["attention"]["position_bias"]), 0.02, rtol=0.3)
    np.testing.assert_array_equal(block["attention"]["qkv"]["bias"], 0)
    np.testing.assert_array_equal(block["mlp_norm"]["scale"], 1)
    assert 0.2 < np.abs(kernel).max() <= 0.25  # uniform within 1 / sqrt(16 inputs)


def test_windows_that_do_not_tile_the_map_are_refused():
    with pytest.raises(ValueError, match=r"windows of 4 x 4 tokens must tile the map, found 6 x 6 tokens"):
        MODEL.init(jax.random.key(0), jnp.zeros((1, 24, 24, 1)))
