"""NetVLAD against PointNetVLAD's, whose batch norms are folded into weights and biases."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from sglpr_jax.models.layers import l2_normalize
from sglpr_jax.models.place_head import NetVLAD

LAYERS = {
    "assignment": ("cluster_weights", "cluster_biases", "bn1"),
    "hidden": ("hidden1_weights", None, "bn2"),
    "gate": ("context_gating.gating_weights", "context_gating.gating_biases", "context_gating.bn1"),
}
"""Our dense layers, and PyTorch's weights, bias and batch norm of each."""


def to_flax(state):
    """PyTorch's parameters as ours; differentiable, so that gradients come back by PyTorch's names."""
    params = {"centres": state["cluster_weights2"][0]}
    for ours, (weights, biases, norm) in LAYERS.items():
        if weights not in state:
            continue
        params[ours] = {"kernel": state[weights], "bias": state.get(biases)}
        if f"{norm}.weight" in state:
            scale = state[f"{norm}.weight"] / jnp.sqrt(state[f"{norm}.running_var"] + 1e-5)
            bias = state[f"{norm}.bias"] - state[f"{norm}.running_mean"] * scale
            params[ours] = {"kernel": state[weights] * scale[None], "bias": bias}
    return params


@pytest.mark.slow
@pytest.mark.parametrize("batch_norm", [0, 1])
@pytest.mark.parametrize("gating", [0, 1])
def test_output_and_gradients_agree(gating, batch_norm, golden, assert_parity):
    tag = f"loupe_gating{gating}_bn{batch_norm}/"
    expected = {key.removeprefix(tag): x for key, x in golden("netvlad").items() if key.startswith(tag)}
    state = {key.removeprefix("state/"): jnp.asarray(x) for key, x in expected.items() if key.startswith("state/")}
    state = {name: x for name, x in state.items() if not name.endswith("num_batches_tracked")}

    def run(state, image):
        b, d = image.shape[:2]
        features = image.transpose(0, 2, 3, 1).reshape(b, -1, d)
        return NetVLAD(clusters=8, output=16, gating=bool(gating)).apply({"params": to_flax(state)}, features)

    @jax.jit
    @jax.grad
    def gradients(state_and_image):
        out = run(*state_and_image)
        return jnp.sum(out * jnp.cos(jnp.arange(out.size, dtype=jnp.float32)).reshape(out.shape))

    image = jnp.asarray(expected["input"])
    assert_parity(run(state, image), expected["eval"], "eval")
    by_name, by_image = gradients((state, image))
    assert_parity(by_image, expected["eval_input_grad"], "eval_input_grad")
    names = [key.removeprefix("eval_gradnorm/") for key in expected if key.startswith("eval_gradnorm/")]
    assert len(names) >= 6
    for name in names:
        assert_parity(jnp.linalg.norm(by_name[name]), expected[f"eval_gradnorm/{name}"], name)


def test_vmap_and_order_of_locals_change_nothing(random_variables):
    module, rng = NetVLAD(clusters=4, output=8), np.random.default_rng(0)
    features = jnp.asarray(rng.normal(size=(3, 20, 6)), jnp.float32)
    variables = random_variables(module, features)
    expected = module.apply(variables, features)
    one_by_one = jax.vmap(module.apply, (None, 0))(variables, features[:, None])[:, 0]
    np.testing.assert_allclose(one_by_one, expected, atol=1e-6)
    np.testing.assert_allclose(module.apply(variables, features[:, rng.permutation(20)]), expected, atol=1e-6)


@pytest.mark.parametrize("scale", [0.0, 1e-30, 1e-8, 1.0, 1e8])
def test_l2_normalize_gives_unit_vectors_or_zero_and_finite_gradients(scale):
    x = scale * jnp.asarray([[3.0, 4.0]])
    expected = [[0.6, 0.8]] if scale > 1e-12 else [[0.0, 0.0]]
    np.testing.assert_allclose(l2_normalize(x), expected, atol=1e-6)
    assert np.isfinite(jax.grad(lambda x: l2_normalize(x)[0, 0])(x)).all()
