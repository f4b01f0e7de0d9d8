"""The public calls: what `describe` promises, and that it pays for nothing that training alone needs."""

import dataclasses
import functools

import flax.traverse_util
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from sglpr_jax.models.backbone_config import SwinConfig
from sglpr_jax.models.config import HeadConfig, ModelConfig, model_preset
from sglpr_jax.models.input_image import prepare
from sglpr_jax.models.sglpr import describe, forward, init, segment
from sglpr_jax.models.weights import Params

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
EPSILON = 2.0**-8
"""Of bfloat16."""

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


@pytest.mark.slow
def test_gradients_are_finite_and_reach_image_and_weights_even_from_an_empty_image(params, images):
    loss = jax.grad(lambda p, x: describe(p, x)[..., 0].sum(), (0, 1))
    both = jnp.stack([jnp.zeros((SIZE, SIZE)), images[0].astype(jnp.float32)])
    weights, image = jax.jit(loss, compiler_options=FAST_COMPILE)(params, both)
    assert isinstance(weights, Params) and weights.config == CONFIG
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves((weights, image)))
    assert np.abs(image[1]).max() > 0
    assert np.abs(weights.weights["backbone"]["patch_embed"]["projection"]["kernel"]).max() > 0


@pytest.mark.parametrize("call", [describe, segment, forward])
def test_images_of_the_wrong_size_are_refused(params, call):
    with pytest.raises(ValueError, match=rf"expected images \[\.\.\., H, W\] of {SIZE} x {SIZE} cells, found shape"):
        call(params, jnp.zeros((SIZE, SIZE, 1)))


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


def test_counts_are_rescaled_as_configured():
    counts = jnp.asarray([[[0, 1, 9, 10, 1000] + [0] * (SIZE - 5)] * SIZE], jnp.int32)
    n = np.asarray(counts[0], np.float64)
    for name, expected in {"raw": n, "log1p": np.log1p(n), "clipped": np.minimum(n, 10) / 10}.items():
        prepared = prepare(counts, dataclasses.replace(CONFIG, counts=name))
        assert prepared.shape == (1, SIZE, SIZE, 1) and prepared.dtype == jnp.float32
        np.testing.assert_allclose(prepared[0, ..., 0], expected, rtol=1e-6)


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


@pytest.mark.parametrize("leading", [(0,), (2, 0)])
def test_no_images_have_no_descriptors(params, images, leading):
    none = jnp.zeros((*leading, *images.shape[-2:]))
    assert describe(params, none).shape == (*leading, params.config.head.descriptor_size)
    with pytest.raises(ValueError, match="expected at least one image"):
        segment(params, none)


def with_head(config: ModelConfig, *, categories: int = 20, **changes) -> ModelConfig:
    return dataclasses.replace(config, categories=categories, head=dataclasses.replace(config.head, **changes))


def weights_of(config: ModelConfig) -> set[str]:
    shapes = jax.eval_shape(lambda: init(jax.random.key(0), config=config)).weights
    return set(flax.traverse_util.flatten_dict(shapes, sep="/"))


def parts(names: set[str]) -> set[str]:
    return {name.split("/")[0] for name in names}


@pytest.fixture(scope="module")
def views():
    """Four images of counts and their maps of classes, of which none is like another."""
    rng = np.random.default_rng(0)
    images = rng.poisson(rng.uniform(0, 4, (4, 1, 1)), (4, SIZE, SIZE))
    return jnp.asarray(images, jnp.int32), jnp.asarray(rng.integers(0, 20, images.shape), jnp.int32)


@pytest.mark.parametrize("what", ["counts", "labels", "counts+labels"])
def test_without_features_there_is_no_backbone(what):
    assert parts(weights_of(with_head(CONFIG, input=what))) == {"place_head"}
    assert parts(weights_of(with_head(POLAR, input=what))) == {"place_head", "patch_embed"}
    assert not with_head(CONFIG, input=what).segments


@pytest.mark.parametrize("call", [describe, forward])
def test_labels_must_be_there_exactly_where_they_are_read(views, call):
    images, labels = views
    reads = Params({}, with_head(CONFIG, input="labels"))
    with pytest.raises(ValueError, match=r"reads labels: expected class maps of shape \(4, 32, 32\), .* found none"):
        call(reads, images)
    with pytest.raises(ValueError, match=r"found shape \(2, 32, 32\)"):
        call(reads, images, labels[:2])
    with pytest.raises(ValueError, match="reads features: expected no labels, found shape"):
        call(Params({}, CONFIG), images, labels)


def test_what_cannot_be_is_refused():
    with pytest.raises(ValueError, match=r"expected categories of labels .* reads counts\+labels, found 0"):
        with_head(CONFIG, categories=0, input="counts+labels")
    with pytest.raises(ValueError, match="expected a model with a segmentation head, found one without"):
        segment(Params({}, with_head(CONFIG, categories=0)), jnp.zeros((SIZE, SIZE)))


@functools.partial(jax.jit, compiler_options=FAST_COMPILE)
def fast_forward(params: Params, images: jax.Array):
    """Descriptors and logits."""
    return forward(params, images)[:2]


def test_descriptors_and_logits_of_bfloat16_agree_and_are_float32(random_params, images):
    params = random_params(POLAR)
    rounded_params = Params(params.weights, dataclasses.replace(params.config, compute="bfloat16"))
    (exact, logits), (rounded, rounded_logits) = (fast_forward(p, images) for p in (params, rounded_params))
    assert rounded.dtype == rounded_logits.dtype == jnp.float32
    np.testing.assert_allclose(np.linalg.norm(rounded, axis=-1), 1, rtol=1e-6)
    off = np.linalg.norm(rounded - exact, axis=-1)
    apart = np.linalg.norm(exact[:, None] - exact[None], axis=-1)
    assert 0 < off.max() < min(4 * EPSILON, 0.5 * apart[~np.eye(len(exact), dtype=bool)].min())  # it mixes up no places
    error = np.asarray(rounded_logits - logits)
    assert np.sqrt(np.square(error).mean()) < 4 * EPSILON * np.sqrt(np.square(logits).mean())
    assert np.abs(error).max() < 16 * EPSILON * np.abs(logits).max()
