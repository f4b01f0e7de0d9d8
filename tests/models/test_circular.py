"""The circular CNN: a rotation of the scan shifts its features and no more."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from sglpr_jax.models import sglpr
from sglpr_jax.models.backbone_config import CircularConfig, SglprConfig
from sglpr_jax.models.circular import CircularNet
from sglpr_jax.models.config import HeadConfig, model_preset

RINGS = CircularConfig(widths=(4, 6, 6), strides=(2, 1, 2), means=(1, 2, 1), fine=())
HEAD = HeadConfig(tap="tokens", cbam=False, channels=(), kernels=(), strides=(), clusters=4)
STEM_ALONE = SglprConfig(stem=RINGS, depths=(), heads=())
CONFIG = dataclasses.replace(
    model_preset("tiny"), field="circle", polar=(16, 32), backbone=STEM_ALONE, detail=6, head=HEAD
)
SGLPR = dataclasses.replace(
    CONFIG,
    backbone=SglprConfig(
        stem=CircularConfig(widths=(4, 6), strides=(2, 1), means=(1, 1), fine=()),
        embed_dim=8,
        depths=(2, 2),
        heads=(1, 2),
        window=2,
    ),
    head=HeadConfig(
        tap="tokens", channels=(8, 8), kernels=(3, 3), strides=(2, 1), means=(1, 2), cbam_reduction=4, clusters=4
    ),
    detail=0,
)
describe = jax.jit(sglpr.describe)
BEV = jax.random.poisson(jax.random.key(1), 0.7, (3, 32, 32)).astype(jnp.float32)


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


@pytest.mark.parametrize("config", [CONFIG, SGLPR], ids=["stem alone", "with attention"])
def test_quarter_turns_leave_the_descriptor(config, random_params):
    params = random_params(config)
    straight = describe(params, BEV)
    assert jnp.abs(straight[0] - straight[1]).max() > 1e-3
    for quarters in (1, 2, 3):
        turned = describe(params, jnp.rot90(BEV, quarters, axes=(1, 2)))
        np.testing.assert_allclose(turned, straight, atol=2e-5)


def test_what_does_not_fit_is_an_error():
    with pytest.raises(ValueError, match="equal numbers of widths, strides and means"):
        CircularConfig(widths=(4, 8))
    with pytest.raises(ValueError, match="at most one value for each width"):
        CircularConfig(widths=(4,), strides=(1,), means=(1,), fine=(3, 3))
    with pytest.raises(ValueError, match=r"multiple of \(8, 4\) cells"):
        dataclasses.replace(CONFIG, polar=(20, 32))
