"""CBAM against the reference implementation, whose batch norm is folded into the convolution."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from sglpr_jax.models.place_head import CBAM, ChannelGate, largest

SPATIAL = "SpatialGate.spatial"


def to_flax(state):
    """PyTorch's parameters as ours; differentiable, so that gradients come back by PyTorch's names."""
    mlp = {ours: f"ChannelGate.mlp.{number}" for ours, number in (("mlp_in", 1), ("mlp_out", 3))}
    channel = {ours: {"kernel": state[f"{t}.weight"].T, "bias": state[f"{t}.bias"]} for ours, t in mlp.items()}
    if f"{SPATIAL}.conv.weight" not in state:
        return {"channel": channel}
    scale = state[f"{SPATIAL}.bn.weight"] / jnp.sqrt(state[f"{SPATIAL}.bn.running_var"] + 1e-5)
    kernel = state[f"{SPATIAL}.conv.weight"].transpose(2, 3, 1, 0) * scale[None, None, None]
    bias = state[f"{SPATIAL}.bn.bias"] - state[f"{SPATIAL}.bn.running_mean"] * scale
    return {"channel": channel, "spatial": {"convolution": {"kernel": kernel, "bias": bias}}}


@pytest.mark.slow
@pytest.mark.parametrize(("tag", "reduction"), [("c32_r16", 16), ("c32_r4", 4), ("c32_r4_nospatial", 4)])
def test_output_and_gradients_agree(tag, reduction, golden, assert_parity):
    expected = {key.removeprefix(f"{tag}/"): x for key, x in golden("cbam").items() if key.startswith(f"{tag}/")}
    state = {key.removeprefix("state/"): jnp.asarray(x) for key, x in expected.items() if key.startswith("state/")}
    state.pop(f"{SPATIAL}.bn.num_batches_tracked", None)

    @jax.jit
    @jax.grad
    def gradients(state_and_image):
        out = run(*state_and_image)
        return jnp.sum(out * jnp.cos(jnp.arange(out.size, dtype=jnp.float32)).reshape(out.shape))

    def run(state, image):
        params, image = to_flax(state), image.transpose(0, 2, 3, 1)
        if "spatial" in params:
            return CBAM(reduction).apply({"params": params}, image).transpose(0, 3, 1, 2)
        return ChannelGate(reduction).apply({"params": params["channel"]}, image).transpose(0, 3, 1, 2)

    image = jnp.asarray(expected["input"])
    assert_parity(run(state, image), expected["eval"], "eval")
    by_name, by_image = gradients((state, image))
    assert_parity(by_image, expected["eval_input_grad"], "eval_input_grad")
    names = [key.removeprefix("eval_gradnorm/") for key in expected if key.startswith("eval_gradnorm/")]
    assert len(names) == (7 if "spatial" in to_flax(state) else 4)
    for name in names:
        assert_parity(jnp.linalg.norm(by_name[name]), expected[f"eval_gradnorm/{name}"], name)


@pytest.mark.slow
def test_jit_and_vmap_agree_and_an_empty_map_has_finite_gradients(random_variables):
    module, image = CBAM(reduction=16), jnp.asarray(np.random.default_rng(0).normal(size=(3, 8, 8, 6)), jnp.float32)
    variables = random_variables(module, image)
    assert variables["params"]["channel"]["mlp_in"]["kernel"].shape == (6, 1)
    expected = module.apply(variables, image)
    np.testing.assert_allclose(jax.jit(module.apply)(variables, image), expected, atol=1e-6)
    one_by_one = jax.jit(jax.vmap(module.apply, (None, 0)))(variables, image[:, None])[:, 0]
    np.testing.assert_allclose(one_by_one, expected, atol=1e-6)
    gradients = jax.jit(jax.grad(lambda v: module.apply(v, jnp.zeros_like(image)).sum()))(variables)
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(gradients))


@pytest.mark.slow
def test_the_gradient_of_the_maximum_survives_rounding():
    """An entry that rounding keeps from being equal to the maximum still has its gradient; ties share it."""
    x = jnp.asarray(np.random.default_rng(0).normal(size=(3, 4, 5)), jnp.float32)
    for derivative in (jax.grad, jax.jacfwd):
        found = derivative(lambda x: jnp.square(largest(x, (1, 2))).sum())(x)
        np.testing.assert_allclose(found, derivative(lambda x: jnp.square(x.max((1, 2))).sum())(x), rtol=1e-6)
    tied = jnp.asarray([2.0, 1.0, np.nextafter(np.float32(2), np.float32(0)), 2.0], jnp.float32)
    np.testing.assert_allclose(jax.grad(lambda x: largest(x, (0,)))(tied), [1 / 3, 0, 1 / 3, 1 / 3], rtol=1e-6)
    assert largest(tied, (-1,)) == 2


@pytest.mark.slow
def test_a_circular_map_may_be_rolled_along_its_columns_and_no_other(random_variables):
    image = jnp.asarray(np.random.default_rng(0).normal(size=(2, 8, 12, 6)), jnp.float32)
    variables = random_variables(CBAM(reduction=3), image)
    rolled = jnp.roll(image, 5, axis=2)
    for circular in (True, False):
        apply = jax.jit(CBAM(reduction=3, circular=circular).apply)
        difference = apply(variables, rolled) - jnp.roll(apply(variables, image), 5, axis=2)
        assert (jnp.abs(difference).max() < 1e-5) == circular
    inner, whole = (CBAM(3, circular).apply(variables, image)[:, :, 3:-3] for circular in (True, False))
    np.testing.assert_allclose(inner, whole, atol=1e-6)  # borders apart they are the same
