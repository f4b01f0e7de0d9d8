"""The public calls: what `describe` promises, and that it pays for nothing that training alone needs."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from sglpr_jax.grid import Grid
from sglpr_jax.models.config import HeadConfig, SwinConfig, model_preset
from sglpr_jax.models.input_image import field_of_view, prepare
from sglpr_jax.models.params import Params
from sglpr_jax.models.sglpr import describe, forward, init, segment

# One stage instead of two, so that a program compiles in a second.
CONFIG = dataclasses.replace(
    model_preset("tiny"),
    backbone=SwinConfig(embed_dim=8, depths=(2,), heads=(2,), window=4, drop_path=0.1),
    head=HeadConfig(channels=(8, 16), kernels=(4, 3), strides=(4, 2), clusters=4, cbam_reduction=4),
)
POLAR = dataclasses.replace(
    CONFIG,
    polar=(16, 32),
    field="circle",
    head=dataclasses.replace(CONFIG.head, tap="tokens", kernels=(3, 3), strides=(1, 1)),
)
SIZE = CONFIG.grid.height
FAST_COMPILE = {"xla_backend_optimization_level": 0}

fast_describe = jax.jit(describe, compiler_options=FAST_COMPILE)


@pytest.fixture(scope="module")
def params(random_params) -> Params:
    return random_params(CONFIG)


@pytest.fixture(scope="module")
def images():
    """Counts of points: six images, of which none is like another."""
    rng = np.random.default_rng(0)
    return jnp.asarray(rng.poisson(rng.uniform(0, 4, (6, 1, 1)), (6, SIZE, SIZE)), jnp.int32)


@pytest.fixture(scope="module")
def descriptors(params, images):
    return fast_describe(params, images)


def test_descriptors_are_256_numbers_of_unit_length_that_differ(descriptors):
    assert descriptors.shape == (6, 256) and descriptors.dtype == jnp.float32
    np.testing.assert_allclose(np.linalg.norm(descriptors, axis=-1), 1, atol=1e-6)
    apart = np.linalg.norm(descriptors[:, None] - descriptors[None], axis=-1) + np.eye(6)
    assert apart.min() > 1e-3


def test_any_leading_axes_and_counts_of_any_type_give_the_same(params, images, descriptors):
    one = fast_describe(params, images[0])
    assert one.shape == (256,)
    np.testing.assert_allclose(one, descriptors[0], atol=1e-5)
    many = fast_describe(params, images.astype(jnp.float32).reshape(1, 2, 3, SIZE, SIZE))
    np.testing.assert_allclose(many.reshape(6, 256), descriptors, atol=1e-5)


@pytest.mark.parametrize("leading", [(0,), (2, 0)])
def test_no_images_have_no_descriptors(params, images, leading):
    none = jnp.zeros((*leading, *images.shape[-2:]))
    assert describe(params, none).shape == (*leading, params.config.head.descriptor_size)
    with pytest.raises(ValueError, match="expected at least one image"):
        segment(params, none)


def test_vmap_agrees(params, images, descriptors):
    mapped = jax.jit(jax.vmap(describe, in_axes=(None, 0)), compiler_options=FAST_COMPILE)
    np.testing.assert_allclose(mapped(params, images), descriptors, atol=1e-5)


@pytest.mark.slow
def test_gradients_are_finite_and_reach_image_and_weights_even_from_an_empty_image(params, images):
    loss = jax.grad(lambda p, x: describe(p, x)[..., 0].sum(), (0, 1))
    both = jnp.stack([jnp.zeros((SIZE, SIZE)), images[0].astype(jnp.float32)])
    weights, image = jax.jit(loss, compiler_options=FAST_COMPILE)(params, both)
    assert isinstance(weights, Params) and weights.config == CONFIG
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves((weights, image)))
    assert np.abs(image[1]).max() > 0
    assert np.abs(weights.weights["backbone"]["patch_embed"]["projection"]["kernel"]).max() > 0


@pytest.mark.parametrize("shape", [(SIZE, SIZE + 2), (3, SIZE // 2, SIZE), (SIZE, SIZE, 1)])
@pytest.mark.parametrize("call", [describe, segment, forward])
def test_images_of_the_wrong_size_are_refused(params, call, shape):
    with pytest.raises(ValueError, match=rf"expected images \[\.\.\., H, W\] of {SIZE} x {SIZE} cells, found shape"):
        call(params, jnp.zeros(shape))


def operations(compiled) -> float:
    return compiled.cost_analysis()["flops"]


def compiled(call, params, images, **options):
    return jax.jit(lambda p, x: call(p, x, **options), compiler_options=FAST_COMPILE).lower(params, images).compile()


def test_describe_computes_nothing_of_the_segmentation_head(params, images):
    backbone = {name: part for name, part in params.weights.items() if name != "segmentation_head"}
    without_head = operations(compiled(describe, Params(backbone, CONFIG), images))
    assert operations(compiled(describe, params, images)) == without_head
    head = 2 * len(images) * SIZE**2 * CONFIG.backbone.width * CONFIG.classes
    assert operations(compiled(forward, params, images)) >= without_head + head


@pytest.mark.parametrize(("detail", "spared"), [(0, set()), (4, {"narrow", "detail"})])
def test_a_head_that_taps_tokens_spares_describe_the_expansion_too(random_params, detail, spared):
    config = dataclasses.replace(POLAR, detail=detail)
    params, image = random_params(config), jnp.zeros((1, SIZE, SIZE))
    needed = {name: part for name, part in params.weights.items() if name in ("backbone", "place_head")}
    assert params.weights.keys() - needed.keys() == {"segmentation_head", "expand"} | spared
    bare = Params(needed, config)
    assert operations(compiled(describe, params, image)) == operations(compiled(describe, bare, image))


def test_with_detail_the_logits_of_a_cell_depend_on_its_own_count(random_params, images):
    """More than those of other cells; what lies beyond the circle still counts for nothing."""
    corner = images.at[:, 2, 3].add(50)
    config = dataclasses.replace(POLAR, detail=4)
    params, segments = random_params(config), jax.jit(segment, compiler_options=FAST_COMPILE)
    assert segments(params, images).shape == (len(images), SIZE, SIZE, 20)
    np.testing.assert_array_equal(segments(params, corner), segments(params, images))
    inside = images.at[:, 16, 20].add(50)
    changed = np.abs(segments(params, inside) - segments(params, images)).max((0, 3))
    assert changed[16, 20] > 3 * np.median(changed)


def test_forward_gives_descriptors_logits_and_every_named_map(params, images, descriptors):
    outputs = jax.jit(forward, compiler_options=FAST_COMPILE)(params, images)
    np.testing.assert_allclose(outputs.descriptor, descriptors, atol=1e-5)
    assert outputs.logits.shape == (6, SIZE, SIZE, 20)
    assert {"patch_embed", "enc0_block1", "norm_up", "pixels", "cbam", "head_convolution1"} <= set(
        outputs.intermediates
    )
    kernel = params.weights["segmentation_head"]["kernel"]
    np.testing.assert_allclose(outputs.logits, outputs.intermediates["pixels"] @ kernel, atol=1e-4)
    sparse = jax.eval_shape(lambda p, x: forward(p, x, segment=3), params, images)
    assert sparse.logits.shape == (2, SIZE, SIZE, 20) and sparse.descriptor.shape == (6, 256)


def test_segment_keeps_the_leading_axes(params, images):
    shape = jax.eval_shape(segment, params, images.reshape(2, 3, SIZE, SIZE)).shape
    assert shape == (2, 3, SIZE, SIZE, 20)


def test_params_are_a_pytree_whose_static_part_is_the_configuration(params):
    leaves, structure = jax.tree.flatten(params)
    assert all(isinstance(leaf, jax.Array) for leaf in leaves)
    assert jax.tree.unflatten(structure, leaves).config is CONFIG
    other = dataclasses.replace(params, config=dataclasses.replace(CONFIG, counts="raw"))
    assert jax.tree.structure(other) != structure
    assert hash(CONFIG) == hash(dataclasses.replace(CONFIG))


def test_counts_are_rescaled_as_configured():
    counts = jnp.asarray([[[0, 1, 9, 10, 1000] + [0] * (SIZE - 5)] * SIZE], jnp.int32)
    n = np.asarray(counts[0], np.float64)
    for name, expected in {"raw": n, "log1p": np.log1p(n), "clipped": np.minimum(n, 10) / 10}.items():
        prepared = prepare(counts, dataclasses.replace(CONFIG, counts=name))
        assert prepared.shape == (1, SIZE, SIZE, 1) and prepared.dtype == jnp.float32
        np.testing.assert_allclose(prepared[0, ..., 0], expected, rtol=1e-6)


def test_the_circle_blanks_what_a_rotation_would_move_out_of_view():
    grid = Grid(height=32, width=48)
    round_view = dataclasses.replace(CONFIG, field="circle", grid=grid)
    sees = field_of_view(round_view)[0]
    for v, u in ((0, 23), (15, 23), (15, 8), (15, 7), (0, 0), (31, 24)):
        assert sees[v, u] == (np.hypot(v - 15.5, u - 23.5) < 16)
    assert field_of_view(dataclasses.replace(round_view, field="square")).all()
    prepared = prepare(jnp.ones((2, 32, 48)), round_view)
    np.testing.assert_allclose(prepared[..., 0], np.broadcast_to(sees * np.log(2), (2, 32, 48)), rtol=1e-6)


def test_the_vehicle_itself_is_not_seen():
    grid = Grid(resolution_m=0.5, height=32, width=32)
    sees = field_of_view(dataclasses.replace(CONFIG, grid=grid, field="square", blind_m=2.0))[0]
    x = (np.arange(32) - 15.5) * 0.5
    np.testing.assert_array_equal(sees, np.hypot(*np.meshgrid(x, x)) >= 2.0)
    assert 40 < (~sees).sum() < 60


def test_the_range_channel_tells_how_far_a_cell_is():
    grid = Grid(resolution_m=0.5, height=32, width=48)
    config, plain = (dataclasses.replace(CONFIG, grid=grid, range_channel=x) for x in (True, False))
    x, y = (np.arange(48) - 23.5) * 0.5, (np.arange(32) - 15.5) * 0.5
    expected = np.hypot(x, y[:, None]) / np.hypot(x[0], y[0])
    prepared = prepare(jnp.ones((2, 32, 48)), config)
    assert prepared.shape == (2, 32, 48, config.channels) == (2, 32, 48, 2)
    np.testing.assert_allclose(prepared[1, ..., 1], expected, rtol=1e-6)
    np.testing.assert_array_equal(prepared[..., :1], prepare(jnp.ones((2, 32, 48)), plain))


def test_what_lies_outside_the_circle_does_not_reach_a_polar_descriptor(random_params, images):
    params = random_params(POLAR)
    outside = ~field_of_view(POLAR)[0]
    changed = jnp.where(outside, 7, images)
    assert (changed != images).any()
    np.testing.assert_array_equal(fast_describe(params, changed), fast_describe(params, images))
    shifted = jnp.roll(images, 3, axis=2)
    assert np.abs(fast_describe(params, shifted) - fast_describe(params, images)).max() > 1e-3


def test_init_makes_every_weight_of_its_preset_from_its_key(random_params):
    config = dataclasses.replace(CONFIG, backbone=dataclasses.replace(CONFIG.backbone, drop_path=0.0))
    params = init(jax.random.key(0), config=config)
    shapes = jax.tree.map(jnp.shape, params.weights)
    assert shapes == jax.tree.map(jnp.shape, random_params(config).weights)
    assert params.config is config
    kernel = params.weights["segmentation_head"]["kernel"]
    assert 0.9 * config.backbone.width**-0.5 < np.abs(kernel).max() <= config.backbone.width**-0.5
    with pytest.raises(ValueError, match=r"expected a model preset \(sglpr, .*\), found 'huge'"):
        init(jax.random.key(0), preset="huge")


def test_a_list_of_images_is_one_clear_error(as_installed, random_params):
    params = random_params(model_preset("tiny"))
    with pytest.raises(TypeError, match="expected images as an array of numpy or JAX, found a list; use"):
        describe(params, [[0.0, 1.0], [2.0, 3.0]])
