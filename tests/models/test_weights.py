"""Parts of a model's weights, grafts, checksums, averages, and the whitening layer."""

import dataclasses
import functools

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import sglpr_jax
from sglpr_jax.models.backbone_config import CircularConfig, SglprConfig
from sglpr_jax.models.config import HeadConfig, model_preset
from sglpr_jax.models.sglpr import describe, init, weight_shapes
from sglpr_jax.models.weights import (
    Params,
    adopt,
    as_tree,
    average,
    by_name,
    descriptor_layers,
    fit_whitening,
    for_places,
    graft,
    own_hash,
    weights_hash,
    with_whitening,
    without_whitening,
)
from sglpr_jax.models.weights_file import load, save


@functools.cache
def fresh(seed: int) -> Params:
    return init(jax.random.key(seed), preset="tiny")


def test_models_that_differ_are_refused_by_the_name_of_what_does():
    one = fresh(0)
    with pytest.raises(ValueError, match="found categories 20 and 0"):
        average([one, for_places(one)])
    head = dataclasses.replace(model_preset("tiny").head, clusters=7)
    with pytest.raises(ValueError, match=r"found head\.clusters \d+ and 7"):
        average([one, init(jax.random.key(0), config=dataclasses.replace(model_preset("tiny"), head=head))])


RNG = np.random.default_rng(0)
CLOUD = RNG.normal(size=(500, 6)) * [3, 1, 0.5, 0.3, 0.2, 0.1] @ RNG.normal(size=(6, 6)) + RNG.normal(size=6)
BEV = jnp.asarray(RNG.poisson(0.7, (4, 32, 32)), jnp.float32)


@pytest.mark.parametrize("power", [0.0, 0.5, 1.0])
def test_the_spread_along_every_component_is_its_own_to_the_power_left(power):
    spread = np.linalg.svd(CLOUD, compute_uv=False)[::-1] / len(CLOUD) ** 0.5
    expected = spread * (spread / spread.max()) ** -power
    mapped = CLOUD @ fit_whitening(CLOUD, power=power)
    np.testing.assert_allclose(mapped.T @ mapped / len(CLOUD), np.diag(expected**2), atol=1e-3)


@pytest.mark.parametrize("n", [1, 20])
def test_equal_descriptors_are_refused(n):
    with pytest.raises(ValueError, match=f"found {n} equal descriptors"):
        fit_whitening(np.ones((n, 6)))


@pytest.mark.slow
def test_fitted_weights_describe_are_stored_and_lose_the_layer_again(random_params, tmp_path):
    params = random_params(model_preset("tiny"))
    before = np.asarray(describe(params, BEV))
    samples = before[:1] + RNG.normal(scale=0.1, size=(600, 256)).astype(np.float32)
    fitted = with_whitening(params, samples)
    expected = before @ fit_whitening(samples)
    expected /= np.linalg.norm(expected, axis=1, keepdims=True)
    np.testing.assert_allclose(describe(fitted, BEV), expected, atol=1e-4)
    np.testing.assert_allclose(describe(load(save(fitted, tmp_path / "weights")), BEV), expected, atol=1e-4)
    chex.assert_trees_all_equal(without_whitening(fitted), params)
    with pytest.raises(ValueError, match="without a whitening layer"):
        with_whitening(fitted, samples)


@pytest.fixture(scope="module")
def params(random_params) -> Params:
    return jax.tree.map(np.asarray, random_params(model_preset("tiny")))


def test_weights_with_and_without_a_segmentation_head_are_grafted_onto_each_other(params):
    kept = {name: values for name, values in params.weights.items() if name != "segmentation_head"}
    given = Params(kept, dataclasses.replace(params.config, categories=0))
    fresh = jax.tree.map(np.zeros_like, params)
    found = graft(given, fresh)
    assert found.config == params.config
    chex.assert_trees_all_equal({k: v for k, v in found.weights.items() if k != "segmentation_head"}, kept)
    chex.assert_trees_all_equal(found.weights["segmentation_head"], fresh.weights["segmentation_head"])
    chex.assert_trees_all_equal(graft(params, given).weights, kept)
    with pytest.raises(ValueError, match=r"segmentation_head/kernel has shape .*, expected no such weight"):
        graft(params, dataclasses.replace(fresh, weights=kept))


def test_only_kernels_may_grow(params):
    weights = by_name(params.weights)
    name = next(name for name in weights if name.endswith("/position_bias"))
    fewer_rows = as_tree(weights | {name: weights[name][1:]})
    with pytest.raises(ValueError, match="position_bias has shape"):
        graft(dataclasses.replace(params, weights=fewer_rows), params)


def with_fine_blocks(*channels):
    stem = CircularConfig(widths=(4, 6), strides=(2, 1), means=(1, 2), fine=channels)
    backbone = SglprConfig(stem=stem, depths=(), heads=())
    head = HeadConfig(tap="tokens", cbam=False, channels=(), kernels=(), strides=(), clusters=4)
    return dataclasses.replace(model_preset("tiny"), field="circle", polar=(16, 32), backbone=backbone, head=head)


@pytest.mark.slow
def test_a_network_grown_by_fine_blocks_begins_as_the_smaller_one():
    small = sglpr_jax.init(jax.random.key(0), config=with_fine_blocks(5))
    grown = graft(small, sglpr_jax.init(jax.random.key(1), config=with_fine_blocks(5, 6)))
    bev = jnp.asarray(np.random.default_rng(0).poisson(0.7, (2, 32, 32)), jnp.float32)
    describe, segment = jax.jit(sglpr_jax.describe), jax.jit(sglpr_jax.segment)
    np.testing.assert_allclose(describe(grown, bev), describe(small, bev), atol=1e-6)
    np.testing.assert_allclose(segment(grown, bev), segment(small, bev), atol=1e-5)
    expected = r"backbone/stem/block_0/convolution/kernel has shape \(3, 3, 6, 4\), expected \(3, 3, 1, 4\)"
    with pytest.raises(ValueError, match=expected):
        graft(small, sglpr_jax.init(jax.random.key(1), config=with_fine_blocks()))


def test_the_hash_changes_with_one_value_and_one_name(params):
    def changed(kernel, name="kernel"):
        head = params.weights["place_head"]
        layer = {"bias": head["convolution_0"]["bias"], name: kernel}
        return weights_hash(Params(params.weights | {"place_head": head | {"convolution_0": layer}}, params.config))

    kernel = params.weights["place_head"]["convolution_0"]["kernel"]
    nudged = kernel.copy()
    nudged.flat[0] = np.nextafter(nudged.flat[0], np.float32(9))
    hashes = [weights_hash(params), changed(nudged), changed(kernel, "other"), changed(kernel.reshape(4, -1))]
    assert len(set(hashes)) == 4
    assert changed(jnp.asarray(kernel)) == weights_hash(params)
    assert len(hashes[0]) == 64


def test_a_model_that_learned_from_a_teacher_has_its_hash_until_it_is_changed():
    teacher, own = fresh(0), fresh(1)
    student = Params(own.weights, dataclasses.replace(own.config, descriptors_of=weights_hash(teacher)))
    assert weights_hash(student) == weights_hash(for_places(student)) == weights_hash(teacher)
    assert own_hash(student) == weights_hash(own) != weights_hash(teacher)
    whitened = with_whitening(student, np.random.default_rng(0).normal(size=(600, 256)))
    assert weights_hash(whitened) == own_hash(whitened) and weights_hash(average([student])) == own_hash(student)


def test_layers_are_adopted_by_name_and_shape():
    source = fresh(0)
    head = dataclasses.replace(source.config.head, clusters=7)
    target = init(jax.random.key(1), config=dataclasses.replace(source.config, head=head, categories=0))
    adopted, theirs, own = (by_name(params.weights) for params in (adopt(source, target), source, target))
    assert adopted.keys() == own.keys()
    different = {name for name, value in adopted.items() if value is not theirs[name]}
    assert {name.split("/")[1] for name in different} == {"netvlad"}
    assert all(adopted[name] is own[name] for name in different)


@pytest.mark.slow
@pytest.mark.parametrize("tap", ["tokens", "pixels"])
@pytest.mark.parametrize("name", ["paper", "sglpr"])
def test_the_layers_of_descriptors_are_those_of_a_model_without_a_segmentation_head(name, tap):
    config = model_preset(name)
    config = dataclasses.replace(config, head=dataclasses.replace(config.head, tap=tap))
    whole = Params(as_tree(dict(weight_shapes(config))), config)
    assert set(by_name(descriptor_layers(whole))) == set(weight_shapes(dataclasses.replace(config, categories=0)))
