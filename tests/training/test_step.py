"""A step in chunks is the step of the whole batch, and it learns."""

import dataclasses
import functools

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from sglpr_jax.data.sampling.batch import Batch
from sglpr_jax.models.sglpr import forward
from sglpr_jax.models.weights import by_name, for_places
from sglpr_jax.training.config import LossConfig, without_untrained_head
from sglpr_jax.training.loss import Summary, joint_loss, triplet, violations
from sglpr_jax.training.presets import load_preset
from sglpr_jax.training.state import new_state
from sglpr_jax.training.step import _chunks, gradients, summarize, train_step

from .conftest import SWIN

FAST_COMPILE = {"xla_backend_optimization_level": 0}


@functools.partial(jax.jit, static_argnames="config", compiler_options=FAST_COMPILE)
def gradients_of(params, batch, config):
    return gradients(params, chunks_of(batch, config), batch, config.loss)


def chunks_of(batch, config):
    return _chunks(batch, *jax.random.split(jax.random.key(0)), config)


def assert_same(found, expected):
    """Equal to float32 accuracy, measured against the largest value of each array."""
    for a, b in zip(jax.tree.leaves(found), jax.tree.leaves(expected), strict=True):
        np.testing.assert_allclose(a, b, rtol=0, atol=1e-4 * np.abs(b).max() + 1e-7)


@pytest.fixture(scope="module")
def whole(config, params, make_batch):
    """The gradient and the metrics of a labelled batch that goes through the network at once."""
    return gradients_of(params, make_batch(0), config)


def test_chunks_give_the_gradient_and_metrics_of_the_whole_batch(config, params, make_batch, whole):
    gradient, metrics = gradients_of(params, make_batch(0), dataclasses.replace(config, chunk=2))
    assert set(metrics) == {"loss", "triplet", "cross_entropy", "dice", "violations"}
    assert_same(metrics, whole[1])
    assert_same(gradient, whole[0])
    assert np.abs(gradient["segmentation_head"]["kernel"]).max() > 1e-3
    assert np.abs(gradient["place_head"]["netvlad"]["centres"]).max() > 1e-3


@pytest.mark.slow
def test_without_labels_the_triplet_loss_is_all_in_chunks_too(config, params, make_batch):
    batch = make_batch(0, images=True)
    gradient, metrics = gradients_of(params, batch, config)
    assert set(metrics) == {"loss", "triplet", "violations"}
    assert metrics["loss"] == metrics["triplet"] > 0
    assert np.abs(gradient["segmentation_head"]["kernel"]).max() == 0
    assert np.abs(gradient["place_head"]["netvlad"]["centres"]).max() > 1e-3
    assert_same(gradients_of(params, batch, dataclasses.replace(config, chunk=4)), (gradient, metrics))


@pytest.fixture(scope="module")
def mapped(make_batch, config):
    """A batch of images of which every third has no labels."""
    batch = make_batch(0, images=True)
    maps = np.random.default_rng(1).integers(0, 20, batch.images.shape).astype(np.int32)
    return batch.replace(maps=maps, labelled=np.arange(config.images) % 3 != 0)


@pytest.mark.slow
def test_images_with_label_maps_teach_semantics_in_chunks_too(config, params, make_batch, mapped):
    gradient, metrics = gradients_of(params, mapped, config)
    assert metrics["cross_entropy"] > 0 and metrics["dice"] > 0
    np.testing.assert_allclose(
        metrics["triplet"], gradients_of(params, make_batch(0, images=True), config)[1]["triplet"]
    )
    assert np.abs(gradient["segmentation_head"]["kernel"]).max() > 1e-3
    assert_same(gradients_of(params, mapped, dataclasses.replace(config, chunk=4)), (gradient, metrics))
    scrambled = np.where(mapped.labelled[:, None, None], mapped.maps, (mapped.maps + 3) % 20)
    assert (scrambled != mapped.maps).any()
    chex.assert_trees_all_equal(gradients_of(params, mapped.replace(maps=scrambled), config)[1], metrics)


def test_the_gradient_of_the_segmentation_losses_comes_from_labelled_images_alone(config, params, mapped):
    batch = jax.tree.map(jnp.asarray, mapped)
    chunk = jax.tree.map(lambda x: x[0], chunks_of(batch, config))

    def segmentation_loss(images):
        metrics = joint_loss(summarize(params, chunk._replace(images=images), config.loss), batch, config.loss)[1]
        return metrics["cross_entropy"] + metrics["dice"]

    gradient = jax.jit(jax.grad(segmentation_loss), compiler_options=FAST_COMPILE)(chunk.images)
    np.testing.assert_array_equal(np.abs(gradient).max((1, 2)) > 0, mapped.labelled)


def test_the_metrics_are_those_of_numpy(config, params, make_batch, whole):
    batch = make_batch(0)
    chunks = chunks_of(batch, config)
    outputs = jax.jit(forward)(params, chunks.images[0])
    d, logits = (np.asarray(x, np.float64) for x in (outputs.descriptor, outputs.logits))

    def distance(a, b):
        return np.linalg.norm(d[a] - d[b])

    triplets = [
        max(0, *(config.loss.margin + distance(a, a + 1) - distance(a, n) for n in (a + 2, a + 3))) for a in (0, 4)
    ]
    np.testing.assert_allclose(whole[1]["triplet"], np.mean(triplets), rtol=1e-4)
    np.testing.assert_allclose(whole[1]["violations"], np.mean(np.array(triplets) > 0))

    p = np.exp(logits - logits.max(-1, keepdims=True))
    p = (p / p.sum(-1, keepdims=True))[batch.labelled]
    truth = np.eye(20)[np.asarray(chunks.maps[0])[batch.labelled]]
    np.testing.assert_allclose(whole[1]["cross_entropy"], -np.log((p * truth).sum(-1)).mean(), rtol=1e-4)
    overlap, total = (2 * p * truth).sum((0, 1, 2)), (p**2 + truth**2).sum((0, 1, 2))
    np.testing.assert_allclose(whole[1]["dice"], np.mean(1 - (overlap + 1e-5) / (total + 1e-5)), rtol=1e-4)
    expected = whole[1]["triplet"] + 0.4 * whole[1]["cross_entropy"] + 0.6 * whole[1]["dice"]
    np.testing.assert_allclose(whole[1]["loss"], expected, rtol=1e-6)


def test_what_lies_under_unlabelled_places_does_not_matter(config, params, make_batch, whole):
    batch = make_batch(0)
    scrambled = np.where(batch.labelled[:, None], batch.classes, (batch.classes + 3) % 20)
    assert (scrambled != batch.classes).any()
    chex.assert_trees_all_equal(gradients_of(params, batch.replace(classes=scrambled), config), whole)


def test_a_batch_without_one_labelled_place_has_no_segmentation_loss(config, params, make_batch):
    batch = make_batch(0).replace(labelled=np.zeros(config.images, bool))
    gradient, metrics = gradients_of(params, batch, config)
    assert metrics["cross_entropy"] == metrics["dice"] == 0
    assert np.abs(gradient["segmentation_head"]["kernel"]).max() == 0
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(gradient))


@pytest.mark.slow
def test_segmenting_every_second_image_is_as_if_the_others_had_no_labels(config, params, make_batch):
    batch = make_batch(0)
    every_second = batch.replace(labelled=batch.labelled & (np.arange(config.images) % 2 == 0))
    expected = gradients_of(params, every_second, config)
    sparse = dataclasses.replace(config, chunk=4, loss=dataclasses.replace(config.loss, segment_every=2))
    found = gradients_of(params, batch, sparse)
    assert_same(found[1], expected[1])
    assert_same(found[0], expected[0])


def test_unlabelled_cells_can_be_left_out_of_the_segmentation_losses(config, params, make_batch):
    batch = make_batch(0)
    config = dataclasses.replace(config, loss=dataclasses.replace(config.loss, ignore_unlabelled=True))
    chunks = chunks_of(batch, config)
    logits = jax.jit(forward)(params, chunks.images[0]).logits
    log_p = np.asarray(jax.nn.log_softmax(logits), np.float64)
    maps = np.asarray(chunks.maps[0])
    counted = (maps != 0) & batch.labelled[:, None, None]
    assert 0 < counted.sum() < maps.size
    truth = np.eye(20)[maps]
    per_image = [-(log_p * truth)[i][counted[i]].sum() / counted[i].sum() for i in np.flatnonzero(batch.labelled)]
    p = np.exp(log_p[counted])
    overlap, total = 2 * (p * truth[counted]).sum(0), np.square(p).sum(0) + np.square(truth[counted]).sum(0)
    metrics = gradients_of(params, batch, config)[1]
    np.testing.assert_allclose(metrics["cross_entropy"], np.mean(per_image), rtol=1e-4)
    np.testing.assert_allclose(metrics["dice"], np.mean(1 - (overlap + 1e-5) / (total + 1e-5)), rtol=1e-4)


@pytest.mark.parametrize(("left_out", "weight"), [("cross_entropy", "ce_weight"), ("dice", "dice_weight")])
def test_a_term_without_weight_is_not_computed(config, params, make_batch, whole, left_out, weight):
    loss = dataclasses.replace(config.loss, **{weight: 0.0})
    _, metrics = gradients_of(params, make_batch(0), dataclasses.replace(config, loss=loss))
    (kept,) = {"cross_entropy", "dice"} - {left_out}
    assert set(metrics) == {"loss", "triplet", "violations", kept}
    np.testing.assert_allclose(metrics[kept], whole[1][kept], rtol=1e-5)
    share = {"cross_entropy": 0.4, "dice": 0.6}[kept]
    np.testing.assert_allclose(metrics["loss"], metrics["triplet"] + share * metrics[kept], rtol=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize("tap", ["tokens", "pixels"])
def test_the_segmentation_may_learn_alone_and_leaves_descriptors_as_they_are(config, random_params, make_batch, tap):
    head = dataclasses.replace(config.model.head, tap=tap)
    loss = dataclasses.replace(config.loss, segmentation_alone=True)
    config = dataclasses.replace(config, model=dataclasses.replace(config.model, head=head, detail=4), loss=loss)
    params, batch = random_params(config.model), make_batch(0)
    found, metrics = gradients_of(params, batch, config)
    joint = dataclasses.replace(config, loss=dataclasses.replace(loss, segmentation_alone=False))
    expected, of_all = gradients_of(params, batch, joint)
    assert "triplet" not in metrics
    np.testing.assert_allclose(metrics["loss"], 0.4 * of_all["cross_entropy"] + 0.6 * of_all["dice"], rtol=1e-5)
    described = by_name(for_places(params).weights)
    for name, gradient in by_name(found).items():
        assert_same(gradient, np.zeros_like(gradient) if name in described else by_name(expected)[name])
    assert {"segmentation_head/kernel", "narrow/kernel"} <= set(by_name(found)) - set(described)

    state = new_state(config, params=jax.tree.map(jnp.copy, params))
    learnt = by_name(train_step(state, batch, config=config)[0].params.weights)
    moved = {name for name, value in by_name(params.weights).items() if not np.array_equal(value, learnt[name])}
    assert moved == set(learnt) - set(described)


def test_a_segmentation_that_learns_alone_needs_a_loss_of_its_own_and_moves_nothing_else(config):
    with pytest.raises(ValueError, match="leaves no loss: expected ce_weight or dice_weight above 0"):
        LossConfig(segmentation_alone=True, ce_weight=0.0, dice_weight=0.0)
    loss = dataclasses.replace(config.loss, segmentation_alone=True)
    decaying = dataclasses.replace(config.optimizer, weight_decay=0.1)
    with pytest.raises(ValueError, match=r"expected optimizer.weight_decay 0, found 0.1"):
        dataclasses.replace(config, loss=loss, optimizer=decaying)
    with pytest.raises(ValueError, match="expected a model with a segmentation head, found one without"):
        dataclasses.replace(config, loss=loss, model=dataclasses.replace(config.model, categories=0))


def test_where_nothing_reads_labels_there_are_no_categories(config):
    no_terms = dataclasses.replace(config.loss, ce_weight=0.0, dice_weight=0.0)
    assert config.model.categories == 20
    assert without_untrained_head(config) == config
    assert without_untrained_head(dataclasses.replace(config, loss=no_terms)).model.categories == 0
    reads = {what: dataclasses.replace(config.model.head, input=what) for what in ("counts", "labels")}
    for what, categories in (("counts", 0), ("labels", 20)):
        model = dataclasses.replace(config.model, head=reads[what])
        settled = without_untrained_head(dataclasses.replace(config, model=model, loss=no_terms))
        assert settled.model.categories == categories


@pytest.mark.slow
def test_a_head_that_reads_labels_learns_from_the_maps_in_chunks_too(config, random_params, make_batch):
    head = dataclasses.replace(config.model.head, input="counts+labels")
    config = dataclasses.replace(config, model=dataclasses.replace(config.model, head=head))
    params, batch = random_params(config.model), make_batch(0)
    gradient, metrics = gradients_of(params, batch, config)
    assert set(metrics) == {"loss", "triplet", "violations"} and set(gradient) == {"patch_embed", "place_head"}
    assert_same(gradients_of(params, batch, dataclasses.replace(config, chunk=4)), (gradient, metrics))
    relabelled = batch.replace(classes=(batch.classes + 1) % 20)
    assert gradients_of(params, relabelled, config)[1]["triplet"] != metrics["triplet"]
    with pytest.raises(ValueError, match="expected class maps"):
        gradients_of(params, batch.replace(classes=None), config)


@pytest.mark.slow
def test_both_passes_over_a_chunk_drop_the_same_branches(config, random_params, make_batch):
    """With stochastic depth, too, the gradient is that of one function, in which every chunk has its own key."""
    backbone = dataclasses.replace(SWIN.backbone, drop_path=0.5)
    config = dataclasses.replace(config, chunk=4, model=dataclasses.replace(SWIN, backbone=backbone))
    params, batch = random_params(config.model), jax.tree.map(jnp.asarray, make_batch(0))

    def loss_of(weights, backbone=backbone):
        model = dataclasses.replace(config.model, backbone=backbone)
        chunks = chunks_of(batch, config)
        parts = [
            summarize(dataclasses.replace(params, weights=weights, config=model), chunk, config.loss)
            for chunk in (jax.tree.map(lambda x, i=i: x[i], chunks) for i in range(config.images // config.chunk))
        ]
        descriptors, sums = zip(*parts, strict=True)
        summed = jax.tree.map(lambda *chunks: sum(chunks), *sums)
        return joint_loss(Summary(jnp.concatenate(descriptors), summed), batch, config.loss)

    found = gradients_of(params, batch, config)
    plain = jax.grad(loss_of, has_aux=True)
    assert_same(found, jax.jit(plain, compiler_options=FAST_COMPILE)(params.weights))
    whole = functools.partial(loss_of, backbone=dataclasses.replace(backbone, drop_path=0.0))
    of_all = jax.jit(whole, compiler_options=FAST_COMPILE)(params.weights)[1]
    assert abs(float(found[1]["loss"] - of_all["loss"])) > 1e-4


def test_the_share_of_violations_is_that_of_the_margin_for_the_smooth_loss_too(make_batch):
    batch = jax.tree.map(jnp.asarray, make_batch(0))
    apart = jnp.eye(8).at[1].set(jnp.eye(8)[0])  # the first anchor has its positive at its place
    for temperature in (0.0, 0.2):
        config = LossConfig(margin=0.3, temperature=temperature)
        assert violations(apart, batch, config) == 0.5
        assert triplet(apart, batch, config) > 0


@pytest.mark.slow
def test_steps_lower_the_loss_and_compile_once(config, random_params, make_batch):
    backbone = dataclasses.replace(SWIN.backbone, depths=(1,), drop_path=0.0)
    config = dataclasses.replace(config, model=dataclasses.replace(SWIN, backbone=backbone))
    params = random_params(config.model)
    chex.clear_trace_counter()
    traced = chex.assert_max_traces(train_step.__wrapped__, n=1)
    step = jax.jit(traced, static_argnames="config", donate_argnames="state", compiler_options=FAST_COMPILE)

    def run(*, steps: int, start: int = 0):
        state = new_state(config, params=jax.tree.map(jnp.copy, params)).replace(step=jnp.int32(start))
        seen = []
        for i in range(steps):
            state, metrics = step(state, make_batch(0), config=config)
            assert state.step == start + i + 1
            seen.append(jax.device_get(metrics))
        return state.params.weights, seen

    weights, metrics = run(steps=25)
    losses = [m["loss"] for m in metrics]
    assert np.mean(losses[-5:]) < 0.9 * np.mean(losses[:5])
    assert metrics[0]["gradient_norm"] > 0 and metrics[0]["update_norm"] > 0
    squares = sum(np.square(leaf).sum() for leaf in jax.tree.leaves(weights))
    np.testing.assert_allclose(metrics[-1]["weight_norm"], np.sqrt(squares), rtol=1e-5)

    again = run(steps=2)[1]
    chex.assert_trees_all_equal(again, metrics[:2])
    assert run(steps=1, start=1)[1][0]["loss"] != losses[0]  # each step has its own rotations


@pytest.mark.slow
def test_the_step_of_the_preset_that_the_pages_train_is_whole():
    """Only traced, for it would be compiled for a minute."""
    config = dataclasses.replace(load_preset("sglpr"), tuples=4)
    grid, images = config.model.grid, config.images
    batch = Batch(
        labelled=np.ones(images, bool),
        negatives=np.arange(images)[None] > config.sampling.positives,
        positives=config.sampling.positives,
        images=np.zeros((images, grid.height, grid.width), np.float32),
        maps=np.zeros((images, grid.height, grid.width), np.int32),
    )
    state = jax.eval_shape(lambda: new_state(config))
    after, metrics = jax.eval_shape(functools.partial(train_step, config=config), state, batch)
    assert jax.tree.structure(after) == jax.tree.structure(state)
    assert {"loss", "triplet", "cross_entropy", "dice"} <= set(metrics)
