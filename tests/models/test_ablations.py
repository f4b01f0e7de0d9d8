"""What tables 4 to 6 and figure 9 switch off is not there: no weights, no computation, and no gradient to go astray."""

import dataclasses

import flax.traverse_util
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from sglpr_jax.models.config import HeadConfig, ModelConfig, SwinConfig, model_preset
from sglpr_jax.models.input_image import field_of_view, prepare
from sglpr_jax.models.params import Params
from sglpr_jax.models.place_head import PlaceHead
from sglpr_jax.models.polar import to_polar
from sglpr_jax.models.sglpr import describe, forward, init, segment
from sglpr_jax.models.weights_file import load, save

HEAD = HeadConfig(channels=(8, 16), kernels=(4, 3), strides=(4, 2), clusters=4, cbam_reduction=4, descriptor_size=32)
TOKEN_HEAD = dataclasses.replace(HEAD, tap="tokens", kernels=(3, 3), strides=(1, 1))
SWIN = SwinConfig(embed_dim=8, depths=(1,), heads=(2,), window=4, drop_path=0.1)
CONFIG = dataclasses.replace(model_preset("tiny"), backbone=SWIN, head=HEAD)
POLAR = dataclasses.replace(CONFIG, polar=(16, 32), field="circle", head=TOKEN_HEAD)
SIZE = CONFIG.grid.height
FAST_COMPILE = {"xla_backend_optimization_level": 0}

fast_describe = jax.jit(describe, compiler_options=FAST_COMPILE)


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


def test_without_cbam_and_netvlad_their_weights_are_not_there():
    whole, bare = weights_of(CONFIG), weights_of(with_head(CONFIG, cbam=False, pooling="mean"))
    gone = {name for name in whole if name.startswith(("place_head/cbam/", "place_head/netvlad/"))}
    assert gone and bare == whole - gone | {
        "place_head/mean_pooling/linear/kernel",
        "place_head/mean_pooling/linear/bias",
    }
    assert weights_of(with_head(CONFIG, cbam=False)) == {name for name in whole if "cbam" not in name}


@pytest.mark.parametrize(("config", "spared"), [(CONFIG, set()), (POLAR, {"expand"})], ids=["pixels", "tokens"])
def test_without_categories_there_is_no_segmentation_head(config, spared):
    assert parts(weights_of(config)) - parts(weights_of(with_head(config, categories=0))) == {
        "segmentation_head",
        *spared,
    }


@pytest.mark.parametrize("what", ["counts", "labels", "counts+labels"])
def test_without_features_there_is_no_backbone(what):
    assert parts(weights_of(with_head(CONFIG, input=what))) == {"place_head"}
    assert parts(weights_of(with_head(POLAR, input=what))) == {"place_head", "patch_embed"}
    assert not with_head(CONFIG, input=what).segments


@pytest.mark.parametrize(("categories", "classes"), [(6, 7), (15, 15), (20, 20), (25, 26), (34, 34)])
def test_there_is_a_logit_for_every_class(categories, classes):
    config = with_head(CONFIG, categories=categories)
    params = jax.eval_shape(lambda: init(jax.random.key(0), config=config))
    shape = jax.eval_shape(segment, params, jnp.zeros((2, SIZE, SIZE))).shape
    assert shape == (2, SIZE, SIZE, classes) and config.classes == classes


def test_mean_pooling_is_numpys(random_variables):
    module = PlaceHead(dataclasses.replace(HEAD, cbam=False, pooling="mean"))
    features = jnp.asarray(np.random.default_rng(0).normal(size=(3, 16, 16, 6)), jnp.float32)
    variables = random_variables(module, features)
    found, seen = jax.jit(module.apply, compiler_options=FAST_COMPILE)(variables, features)
    assert set(seen) == {"head_convolution0", "head_convolution1"}
    layer = variables["params"]["mean_pooling"]["linear"]
    expected = np.asarray(seen["head_convolution1"], np.float64).mean((1, 2)) @ layer["kernel"] + layer["bias"]
    expected /= np.linalg.norm(expected, axis=-1, keepdims=True)
    np.testing.assert_allclose(found, expected, atol=1e-5)


@pytest.mark.slow
def test_a_head_for_pixels_reads_counts_and_one_plane_for_each_class(random_params, views):
    config = dataclasses.replace(with_head(CONFIG, input="counts+labels"), field="circle")
    params, (images, labels) = random_params(config), views
    found = fast_describe(params, images, labels)
    assert found.shape == (4, 32)
    planes = np.eye(20, dtype=np.float32)[np.where(field_of_view(config), labels, 0)]
    planes = jnp.concatenate([prepare(images, config), planes], axis=-1)
    expected, _ = PlaceHead(config.head).apply({"params": params.weights["place_head"]}, planes)
    np.testing.assert_allclose(found, expected, atol=1e-5)


@pytest.mark.slow
def test_a_polar_head_for_tokens_reads_patches_of_each_class_s_share(random_params, views):
    config = with_head(POLAR, input="labels")
    params, (images, labels) = random_params(config), views
    planes = np.eye(20, dtype=np.float32)[np.where(field_of_view(config), labels, 0)]
    polar = np.asarray(to_polar(jnp.asarray(planes), config.grid, *config.polar), np.float64)
    patches = polar.reshape(4, 4, 4, 8, 4, 20).transpose(0, 1, 3, 2, 4, 5).reshape(4, 4, 8, -1)
    weights = jax.tree.map(np.asarray, params.weights)
    layer, norm = (weights["patch_embed"][name] for name in ("projection", "norm"))
    tokens = patches @ layer["kernel"].reshape(-1, config.backbone.width) + layer["bias"]
    tokens = (tokens - tokens.mean(-1, keepdims=True)) / np.sqrt(tokens.var(-1, keepdims=True) + 1e-5)
    tokens = jnp.asarray(tokens * norm["scale"] + norm["bias"], jnp.float32)
    expected, _ = PlaceHead(config.head, circular=True).apply({"params": weights["place_head"]}, tokens)
    np.testing.assert_allclose(fast_describe(params, images, labels), expected, atol=1e-5)
    np.testing.assert_array_equal(fast_describe(params, images + 1, labels), fast_describe(params, images, labels))


@pytest.mark.slow
def test_labels_work_under_jit_and_vmap_and_with_any_leading_axes(random_params, views):
    params = random_params(with_head(POLAR, input="counts+labels"))
    images, labels = views
    together = fast_describe(params, images, labels)
    one_by_one = jax.jit(jax.vmap(describe, in_axes=(None, 0, 0)), compiler_options=FAST_COMPILE)
    np.testing.assert_allclose(one_by_one(params, images, labels), together, atol=1e-5)
    square = fast_describe(params, *(view.reshape(2, 2, SIZE, SIZE) for view in views))
    np.testing.assert_allclose(square.reshape(4, -1), together, atol=1e-5)
    for changed in (fast_describe(params, images[::-1], labels), fast_describe(params, images, labels[::-1])):
        assert np.abs(changed - together).max() > 1e-3


@pytest.mark.slow
@pytest.mark.parametrize("what", ["counts+labels", "counts"])
def test_the_gradient_reaches_every_weight(random_params, views, what):
    config = with_head(POLAR, input=what, pooling="mean")
    params, (images, labels) = random_params(config), views
    target = jax.random.normal(jax.random.key(0), (len(images), config.head.descriptor_size))

    @jax.jit
    def gradient(params):
        read = labels if config.head.reads_labels else None
        return jax.grad(lambda p: (describe(p, images, read) * target).sum())(params)

    for path, leaf in jax.tree.leaves_with_path(gradient(params).weights):
        assert np.isfinite(leaf).all() and np.abs(leaf).max() > 0, path


@pytest.mark.slow
def test_describe_costs_less_without_a_backbone(random_params, views):
    def operations(config):
        compiled = fast_describe.lower(random_params(config), views[0]).compile()
        return compiled.cost_analysis()["flops"]

    whole = operations(CONFIG)
    assert operations(with_head(CONFIG, input="counts")) < 0.5 * whole
    assert operations(with_head(CONFIG, categories=0)) == whole  # describe never paid for that head


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
    with pytest.raises(
        ValueError, match=r"expected categories of labels for a head that reads counts\+labels, found 0"
    ):
        with_head(CONFIG, categories=0, input="counts+labels")
    with pytest.raises(ValueError, match="expected a model with a segmentation head, found one without"):
        segment(Params({}, with_head(CONFIG, categories=0)), jnp.zeros((SIZE, SIZE)))


@pytest.mark.parametrize(
    "config",
    [with_head(CONFIG, cbam=False, pooling="mean", categories=0), with_head(POLAR, input="labels", categories=25)],
    ids=["bare", "labels"],
)
def test_weights_of_an_ablation_come_back(random_params, config, tmp_path):
    found = load(save(random_params(config), tmp_path / "weights"))
    assert found.config == config
