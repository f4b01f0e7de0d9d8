"""The segmentation head's look at the image: a convolution that goes around a polar image, then a mix."""

import jax
import numpy as np
import pytest
from jax.scipy.special import erf
from scipy.ndimage import correlate1d

from sglpr_jax.models.detail import Detail


@pytest.fixture(scope="module")
def features():
    keys = jax.random.split(jax.random.key(0))
    return jax.random.normal(keys[0], (2, 8, 12, 3)), jax.random.normal(keys[1], (2, 8, 12, 2))


def convolved(image, kernel, columns: str) -> np.ndarray:
    """Row by row of the kernel, so that rows are padded with zeros and columns as asked."""
    size, _, inputs, outputs = kernel.shape
    image = np.pad(image, ((0, 0), (size // 2, size // 2), (0, 0), (0, 0)))
    found = np.zeros((len(image), image.shape[1] - size + 1, image.shape[2], outputs))
    for dv, i, o in np.ndindex(size, inputs, outputs):
        rows = image[:, dv : dv + found.shape[1], :, i]
        found[..., o] += correlate1d(rows, kernel[dv, :, i, o], axis=2, mode=columns)
    return found


def reference(weights, pixels, image, columns: str) -> np.ndarray:
    for name in ("local0", "local1"):
        kernel, bias = (np.asarray(weights[name][x]) for x in ("kernel", "bias"))
        image = np.maximum(convolved(image, kernel, columns) + bias, 0)
    mixed = np.concatenate([pixels, image], axis=-1) @ np.asarray(weights["mix"]["kernel"])
    mixed += np.asarray(weights["mix"]["bias"])
    return mixed * 0.5 * (1 + np.asarray(erf(mixed / np.sqrt(2))))


@pytest.mark.parametrize(("circular", "columns"), [(True, "wrap"), (False, "constant")])
def test_detail_is_the_reference(features, circular, columns):
    module = Detail(5, circular)
    variables = jax.jit(module.init)(jax.random.key(1), *features)
    expected = reference(variables["params"], *(np.asarray(x) for x in features), columns)
    found = jax.jit(module.apply)(variables, *features)
    np.testing.assert_allclose(found, expected, atol=1e-5)
    each = jax.vmap(lambda p, i: module.apply(variables, p[None], i[None])[0])(*features)
    np.testing.assert_allclose(each, expected, atol=1e-5)
