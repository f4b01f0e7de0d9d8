"""The segmentation head's look at the image: convolutions that see zeros beyond its border, then a mix."""

import jax
import numpy as np
import pytest
from jax.scipy.special import erf
from scipy.ndimage import correlate

from sglpr_jax.models.segmentation_head import Detail


@pytest.fixture(scope="module")
def features():
    keys = jax.random.split(jax.random.key(0))
    return jax.random.normal(keys[0], (2, 8, 12, 3)), jax.random.normal(keys[1], (2, 8, 12, 2))


def convolved(image, kernel) -> np.ndarray:
    found = np.zeros((*image.shape[:3], kernel.shape[-1]))
    for b, i, o in np.ndindex(len(image), *kernel.shape[2:]):
        found[b, ..., o] += correlate(image[b, ..., i], kernel[..., i, o], mode="constant")
    return found


def reference(weights, features, image) -> np.ndarray:
    for name in ("local0", "local1"):
        kernel, bias = (np.asarray(weights[name][x]) for x in ("kernel", "bias"))
        image = np.maximum(convolved(image, kernel) + bias, 0)
    mixed = np.concatenate([features, image], axis=-1) @ np.asarray(weights["mix"]["kernel"])
    mixed += np.asarray(weights["mix"]["bias"])
    return mixed * 0.5 * (1 + np.asarray(erf(mixed / np.sqrt(2))))


@pytest.mark.slow
def test_detail_is_the_reference(features):
    module = Detail(5)
    variables = jax.jit(module.init)(jax.random.key(1), *features)
    expected = reference(variables["params"], *(np.asarray(x) for x in features))
    found = jax.jit(module.apply)(variables, *features)
    np.testing.assert_allclose(found, expected, atol=1e-5)
    each = jax.vmap(lambda f, i: module.apply(variables, f[None], i[None])[0])(*features)
    np.testing.assert_allclose(each, expected, atol=1e-5)
