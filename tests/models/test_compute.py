"""bfloat16 products under float32 weights: the same descriptors within its precision, gradients that can be used."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from sglpr_jax.grid import Grid
from sglpr_jax.models import sglpr
from sglpr_jax.models.config import HeadConfig, ModelConfig, SwinConfig, model_preset
from sglpr_jax.models.params import Params

HEAD = HeadConfig(tap="tokens", channels=(16,), kernels=(3,), strides=(1,), cbam_reduction=4, clusters=4)
SWIN = SwinConfig(embed_dim=8, depths=(1,), heads=(2,), window=4, drop_path=0.0)
TINY = dataclasses.replace(
    model_preset("tiny"),
    grid=Grid(resolution_m=3.2, height=16, width=16),
    backbone=SWIN,
)
MODELS: dict[str, ModelConfig] = {
    "pixels": dataclasses.replace(TINY, head=dataclasses.replace(HEAD, tap="pixels", strides=(4,), kernels=(4,))),
    "polar": dataclasses.replace(
        TINY,
        field="circle",
        polar=(16, 32),
        backbone=SWIN,
        detail=4,
        head=HEAD,
    ),
    "raw, mean": dataclasses.replace(TINY, head=dataclasses.replace(HEAD, input="counts", pooling="mean", cbam=False)),
}
EPSILON = 2.0**-8
"""Of bfloat16."""
FAST_COMPILE = {"xla_backend_optimization_level": 0}


@pytest.fixture(params=MODELS)
def params(request, random_params) -> Params:
    return random_params(MODELS[request.param])


@pytest.fixture
def images() -> jax.Array:
    return jnp.asarray(np.random.default_rng(1).poisson(1.0, (6, 16, 16)).astype(np.float32))


@functools.partial(jax.jit, compiler_options=FAST_COMPILE)
def forward(params: Params, images: jax.Array):
    """Descriptors and logits."""
    return sglpr.forward(params, images)[:2]


def in_bfloat16(params: Params) -> Params:
    return Params(params.weights, dataclasses.replace(params.config, compute="bfloat16"))


def lowered(params: Params, images: jax.Array) -> str:
    return forward.lower(params, images).as_text()


def test_descriptors_and_logits_agree_and_are_float32(params, images):
    (exact, logits), (rounded, rounded_logits) = (forward(p, images) for p in (params, in_bfloat16(params)))
    assert rounded.dtype == jnp.float32
    np.testing.assert_allclose(np.linalg.norm(rounded, axis=-1), 1, rtol=1e-6)
    exact, rounded = np.asarray(exact), np.asarray(rounded)
    off = np.linalg.norm(rounded - exact, axis=-1)
    apart = np.linalg.norm(exact[:, None] - exact[None], axis=-1)
    assert 0 < off.max() < 4 * EPSILON
    assert off.max() < 0.5 * apart[~np.eye(len(exact), dtype=bool)].min()  # it does not mix places up
    if logits is not None:
        assert rounded_logits.dtype == jnp.float32
        error = np.asarray(rounded_logits - logits)
        assert np.sqrt(np.square(error).mean()) < 4 * EPSILON * np.sqrt(np.square(logits).mean())
        assert np.abs(error).max() < 16 * EPSILON * np.abs(logits).max()


@pytest.mark.slow
def test_gradients_are_float32_finite_and_nearly_those_of_float32(params, images):
    def loss(weights, config):
        descriptors, logits, _ = sglpr.forward(Params(weights, config), images)
        alike = (descriptors[:1] * descriptors[1:]).sum()
        return alike if logits is None else alike + jnp.square(logits).mean()

    gradient = jax.jit(jax.grad(loss), static_argnums=1, compiler_options=FAST_COMPILE)
    exact = gradient(params.weights, params.config)
    rounded = gradient(params.weights, in_bfloat16(params).config)
    assert all(leaf.dtype == jnp.float32 and np.isfinite(leaf).all() for leaf in jax.tree.leaves(rounded))
    flat = [np.concatenate([np.ravel(leaf) for leaf in jax.tree.leaves(tree)]) for tree in (exact, rounded)]
    cosine = flat[0] @ flat[1] / np.linalg.norm(flat[0]) / np.linalg.norm(flat[1])
    assert 0.98 < cosine < 1 - 1e-9


def test_an_empty_image_and_one_of_many_points_stay_finite(params, images):
    extremes = images.at[0].set(0.0).at[1].set(5000.0)
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(forward(in_bfloat16(params), extremes)))


def test_float32_holds_no_bfloat16_and_bfloat16_multiplies_in_it(params, images):
    assert "bf16" not in lowered(params, images)
    program = lowered(in_bfloat16(params), images)
    products = [line for line in program.splitlines() if "stablehlo.dot_general" in line or "convolution(" in line]
    inputs = [line.rsplit(" : (", 1)[1].split(") ->")[0] for line in products]
    in_float32 = [shapes for shapes in inputs if "bf16" not in shapes]
    # Left in float32: what follows NetVLAD's sums or the mean, the lookup of position biases, and their transposes.
    assert len(in_float32) < len(inputs) / 2 or params.config.head.input == "counts"
    assert all("f32" not in shapes.replace("bf16", "") for shapes in inputs if "bf16" in shapes)
