"""Initial values: distributions equal to Flax's initializers, drawn without compiling."""

from typing import Any

import flax.linen as nn
import jax
import numpy as np
import pytest
from scipy import stats

import sglpr_jax
from sglpr_jax.models import initial
from tests.tiny import MODEL

SHAPE = (5, 3, 40, 200)
OF_FLAX = {
    "normal": (initial.normal(0.02), nn.initializers.normal(0.02)),
    "he_normal": (initial.he_normal, nn.initializers.he_normal()),
    "lecun_normal": (initial.lecun_normal, nn.initializers.lecun_normal()),
    "torch_uniform": (initial.torch_uniform, nn.initializers.variance_scaling(1 / 3, "fan_in", "uniform")),
    "uniform": (initial.uniform(0.3), lambda key, shape: jax.random.uniform(key, shape, minval=-0.3, maxval=0.3)),
}
BOUNDED = ("he_normal", "lecun_normal", "torch_uniform", "uniform")


@pytest.mark.parametrize("name", OF_FLAX)
def test_a_distribution_is_that_of_flax(name):
    ours, flax = (np.asarray(draw(jax.random.key(1), SHAPE)).ravel() for draw in OF_FLAX[name])
    assert ours.dtype == np.float32
    different: Any = stats.ks_2samp(ours, flax)
    assert different.statistic < 0.008
    np.testing.assert_allclose(ours.std(), flax.std(), rtol=0.01)
    if name in BOUNDED:
        np.testing.assert_allclose(np.abs(ours).max(), np.abs(flax).max(), rtol=0.02)


def test_weights_differ_by_key_and_by_name_and_not_by_shape_of_others():
    drawn = [sglpr_jax.init(jax.random.key(seed), config=MODEL).weights for seed in (0, 0, 1)]
    kernels = [
        {jax.tree_util.keystr(path): np.asarray(leaf) for path, leaf in jax.tree_util.tree_leaves_with_path(tree)}
        for tree in drawn
    ]
    random = [name for name, leaf in kernels[0].items() if leaf.std() > 0]
    assert all(np.array_equal(kernels[0][name], kernels[1][name]) for name in random)
    assert not any(np.array_equal(kernels[0][name], kernels[2][name]) for name in random)
    first = {kernels[0][name].ravel()[:4].tobytes() for name in random}
    assert len(first) == len(random)


def test_init_compiles_nothing(monkeypatch):
    def compiled(*_args, **_options):
        raise AssertionError("a program was compiled")

    key = jax.random.key(5)
    sglpr_jax.init(key, config=MODEL)
    monkeypatch.setattr("jax._src.compiler.compile_or_get_cached", compiled)
    jax.clear_caches()
    sglpr_jax.init(key, config=MODEL)
