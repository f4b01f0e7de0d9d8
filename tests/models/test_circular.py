"""The circular CNN: a rotation of the scan shifts its features and no more."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from sglpr_jax.models import sglpr
from sglpr_jax.models.backbone_config import CircularConfig
from sglpr_jax.models.circular import CircularNet
from sglpr_jax.models.config import HeadConfig, ModelConfig, model_preset
from sglpr_jax.models.place_head import amplitudes

RINGS = CircularConfig(widths=(4, 6, 6), strides=(2, 1, 2), means=(1, 2, 1))
HEAD = HeadConfig(tap="tokens", cbam=False, channels=(), kernels=(), strides=(), clusters=4)
CONFIG = dataclasses.replace(model_preset("tiny"), field="circle", polar=(16, 32), backbone=RINGS, detail=6, head=HEAD)
SPECTRUM = dataclasses.replace(CONFIG, head=dataclasses.replace(HEAD, pooling="spectrum"))
describe, segment = jax.jit(sglpr.describe), jax.jit(sglpr.segment)
BEV = jax.random.poisson(jax.random.key(1), 0.7, (3, 32, 32)).astype(jnp.float32)


@pytest.fixture(scope="module", params=[CONFIG, SPECTRUM], ids=["netvlad", "spectrum"])
def params(request, random_params):
    return random_params(request.param)


@pytest.mark.slow
@pytest.mark.parametrize("fine", [(), (3, 5)])
def test_maps_shrink_as_configured_and_turn_with_the_image(fine, random_variables):
    image = jax.random.normal(jax.random.key(0), (2, 16, 32, 2))
    net = CircularNet(dataclasses.replace(RINGS, fine=fine))
    variables = random_variables(net, image)
    maps = net.apply(variables, image)
    joining = [*fine, 0, 0, 0, 0]
    assert [m.shape for m in maps] == [
        (2, 8, 16, 2 + joining[0]),
        (2, 4, 16, 4 + joining[1]),
        (2, 4, 8, 6),
        (2, 2, 8, 6),
    ]
    np.testing.assert_allclose(maps[0][..., :2], image.reshape(2, 8, 2, 16, 2, 2).mean((2, 4)), atol=1e-6)
    turned = net.apply(variables, jnp.roll(image, 8, axis=2))  # two sectors of the last map
    np.testing.assert_allclose(turned[-1], jnp.roll(maps[-1], 2, axis=2), atol=1e-5)


def test_quarter_turns_leave_the_descriptor(params):
    straight = describe(params, BEV)
    assert jnp.abs(straight[0] - straight[1]).max() > 1e-3
    for quarters in (1, 2, 3):
        turned = describe(params, jnp.rot90(BEV, quarters, axes=(1, 2)))
        np.testing.assert_allclose(turned, straight, atol=1e-5)


def test_amplitudes_are_numpys_and_stay_where_the_columns_are_shifted():
    columns = jax.random.normal(jax.random.key(0), (2, 12, 3))
    expected = np.abs(np.fft.rfft(columns, axis=1, norm="ortho"))
    found = jax.jit(amplitudes, static_argnums=1)(columns, 7)
    np.testing.assert_allclose(found, expected, atol=2e-3)  # sqrt(FLOOR) where an amplitude is zero
    np.testing.assert_allclose(amplitudes(jnp.roll(columns, 5, axis=1), 7), found, atol=1e-5)
    assert jnp.isfinite(jax.grad(lambda c: amplitudes(c, 7).sum())(jnp.zeros((1, 12, 3)))).all()


def test_what_does_not_fit_is_an_error():
    with pytest.raises(ValueError, match="equal numbers of widths, strides and means"):
        CircularConfig(widths=(4, 8))
    with pytest.raises(ValueError, match="at most one value for each width"):
        CircularConfig(widths=(4,), strides=(1,), means=(1,), fine=(3, 3))
    with pytest.raises(ValueError, match="'circular' requires a polar image"):
        ModelConfig(backbone=RINGS)
    with pytest.raises(ValueError, match=r"multiple of \(8, 4\) cells"):
        dataclasses.replace(CONFIG, polar=(20, 32))
