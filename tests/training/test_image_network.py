"""Input and gradient of a step: a step in chunks equals a step of the whole batch, and the loss falls."""

import dataclasses
import functools

import chex
import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

from sglpr_jax.grid import Grid
from sglpr_jax.labels import UNLABELLED
from sglpr_jax.models.sglpr import describe, forward, init
from sglpr_jax.models.weights import by_name, for_places
from sglpr_jax.models.weights_file import save
from sglpr_jax.training.batches import Batch, in_batch_order, in_network_order
from sglpr_jax.training.config import LossConfig, OcclusionConfig, OptimizerConfig, without_untrained_head
from sglpr_jax.training.image_network import (
    ImageNetwork,
    _network_input,
    _random_angles,
    gradients,
    summarize,
    unoccluded_cells,
)
from sglpr_jax.training.loss_terms import Summary, joint_loss
from sglpr_jax.training.step import TrainState, train_step

from .conftest import FAST_COMPILE, SWIN


@functools.partial(jax.jit, static_argnames="config", compiler_options=FAST_COMPILE)
def gradients_of(params, batch, config):
    return gradients(params, chunks_of(batch, config), batch, config.loss)


def chunks_of(batch, config):
    return _network_input(batch, *jax.random.split(jax.random.key(0)), config)


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


@pytest.mark.parametrize("ignore", [False, True])
def test_the_metrics_are_those_of_numpy(config, params, make_batch, ignore):
    batch = make_batch(0)
    config = dataclasses.replace(config, loss=dataclasses.replace(config.loss, ignore_unlabelled=ignore))
    metrics = gradients_of(params, batch, config)[1]
    chunks = chunks_of(batch, config)
    outputs = jax.jit(forward)(params, chunks.images[0])
    d, logits = (np.asarray(x, np.float64) for x in (outputs.descriptor, outputs.logits))

    def distance(a, b):
        return np.linalg.norm(d[a] - d[b])

    triplets = [
        max(0, *(config.loss.margin + distance(a, a + 1) - distance(a, n) for n in (a + 2, a + 3))) for a in (0, 4)
    ]
    np.testing.assert_allclose(metrics["triplet"], np.mean(triplets), rtol=1e-4)
    np.testing.assert_allclose(metrics["violations"], np.mean(np.array(triplets) > 0))

    p = np.exp(logits - logits.max(-1, keepdims=True))
    p = (p / p.sum(-1, keepdims=True))[batch.labelled]
    maps = np.asarray(chunks.maps[0])[batch.labelled]
    truth, counted = np.eye(20)[maps], (maps != 0) | (not ignore)
    assert counted.any() and counted.all() == (not ignore)
    per_image = [-np.log((p * truth).sum(-1))[i][counted[i]].mean() for i in range(len(maps))]
    np.testing.assert_allclose(metrics["cross_entropy"], np.mean(per_image), rtol=1e-4)
    p, truth = p[counted], truth[counted]
    overlap, total = (2 * p * truth).sum(0), (p**2 + truth**2).sum(0)
    np.testing.assert_allclose(metrics["dice"], np.mean(1 - (overlap + 1e-5) / (total + 1e-5)), rtol=1e-4)
    expected = metrics["triplet"] + 0.4 * metrics["cross_entropy"] + 0.6 * metrics["dice"]
    np.testing.assert_allclose(metrics["loss"], expected, rtol=1e-6)


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


@pytest.mark.slow
def test_training_the_segmentation_alone_keeps_the_descriptors(config, random_params, make_batch):
    head = dataclasses.replace(config.model.head, tap="pixels")
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


def test_a_teacher_replaces_the_triplet_loss(config, random_params, make_batch, tmp_path):
    """The loss is the mean squared distance from the descriptors of the teacher, which has no loss itself."""
    teacher = init(jax.random.key(7), config=dataclasses.replace(config.model, categories=0))
    save(teacher, tmp_path / "teacher")
    config = dataclasses.replace(
        config, loss=LossConfig(teacher=str(tmp_path / "teacher"), ce_weight=0.0, dice_weight=0.0), chunk=2
    )
    config = without_untrained_head(config)
    params, batch, key = random_params(config.model), make_batch(0), jax.random.key(0)

    def step(params):
        return ImageNetwork(config).gradient(TrainState(jnp.int32(0), params, None), batch, key)

    found = jax.jit(step, compiler_options=FAST_COMPILE)(params)
    images = chunks_of(batch, config).images.reshape(-1, 16, 16)
    apart = np.asarray(describe(params, images)) - np.asarray(describe(teacher, images))
    assert set(found.metrics) == {"loss", "teacher", "violations"}
    np.testing.assert_allclose(found.metrics["loss"], (apart**2).sum(-1).mean(), rtol=1e-4)
    same = jax.jit(step, compiler_options=FAST_COMPILE)(teacher)
    assert float(same.metrics["loss"]) < 1e-6
    with pytest.raises(ValueError, match=r"expected no loss.teacher, found sglpr"):
        LossConfig(teacher="sglpr", segmentation_alone=True)


def test_muon_updates_matrices_by_equal_singular_values_and_vectors_by_adam(config):
    optimizer = OptimizerConfig(algorithm="muon", learning_rate=0.02)
    network = ImageNetwork(dataclasses.replace(config, optimizer=optimizer))
    rng = np.random.default_rng(0)
    weights = {
        "convolution": rng.normal(size=(3, 3, 4, 8)),
        "layer": rng.normal(size=(6, 24)) * 1e-3,
        "bias": rng.normal(size=7),
    }
    weights = jax.tree.map(lambda array: jnp.asarray(array, jnp.float32), weights)
    updates, _ = network.optimizer.update(weights, network.optimizer.init(weights), weights)
    for name, inputs, outputs in (("convolution", 36, 8), ("layer", 6, 24)):
        matrix = np.asarray(updates[name], np.float64).reshape(inputs, outputs)
        expected = 0.02 * max(1, outputs / inputs) ** 0.5
        singular = np.linalg.svd(matrix, compute_uv=False) / expected
        assert singular.min() > 0.6 and singular.max() < 1.3  # Newton-Schulz iterations are not exact
        assert (matrix * weights[name].reshape(inputs, outputs)).sum() < 0  # against the gradient
    adam = optax.nadamw(0.002, weight_decay=0.0)
    expected, _ = adam.update(weights["bias"], adam.init(weights["bias"]), weights["bias"])
    np.testing.assert_allclose(updates["bias"], expected, rtol=1e-6)


def test_segmentation_alone_needs_a_segmentation_loss_and_head(config):
    with pytest.raises(ValueError, match="leaves no loss: expected ce_weight or dice_weight above 0"):
        LossConfig(segmentation_alone=True, ce_weight=0.0, dice_weight=0.0)
    loss = dataclasses.replace(config.loss, segmentation_alone=True)
    with pytest.raises(ValueError, match="expected a model with a segmentation head, found one without"):
        dataclasses.replace(config, loss=loss, model=dataclasses.replace(config.model, categories=0))


@pytest.mark.slow
def test_both_passes_over_a_chunk_drop_the_same_branches(config, random_params, make_batch):
    """With stochastic depth, too, the gradient is that of one function, in which every chunk has its own key."""
    backbone = dataclasses.replace(SWIN.backbone, drop_path=0.5)
    config = dataclasses.replace(config, chunk=4, model=dataclasses.replace(SWIN, backbone=backbone))
    params, batch = random_params(config.model), jax.tree.map(jnp.asarray, make_batch(0))

    def loss_of(weights):
        chunks = chunks_of(batch, config)
        parts = [
            summarize(dataclasses.replace(params, weights=weights), chunk, config.loss)
            for chunk in (jax.tree.map(lambda x, i=i: x[i], chunks) for i in range(config.images // config.chunk))
        ]
        descriptors, sums = zip(*parts, strict=True)
        summed = jax.tree.map(lambda *chunks: sum(chunks), *sums)
        return joint_loss(Summary(jnp.concatenate(descriptors), summed), batch, config.loss)

    found = gradients_of(params, batch, config)
    plain = jax.grad(loss_of, has_aux=True)
    assert_same(found, jax.jit(plain, compiler_options=FAST_COMPILE)(params.weights))


@pytest.mark.slow
def test_steps_lower_the_loss_and_compile_once(config, params, make_batch):
    chex.clear_trace_counter()
    traced = chex.assert_max_traces(train_step.__wrapped__, n=1)
    step = jax.jit(traced, static_argnames="network", donate_argnames="state", compiler_options=FAST_COMPILE)
    network = ImageNetwork(config)

    def run(*, steps: int, start: int = 0):
        state = network.new_state(jax.tree.map(jnp.copy, params)).replace(step=jnp.int32(start))
        seen = []
        for i in range(steps):
            state, metrics = step(state, make_batch(0), network=network)
            assert state.step == start + i + 1
            seen.append(jax.device_get(metrics))
        return state.params.weights, seen

    weights, metrics = run(steps=25)
    losses = [m["loss"] for m in metrics]
    assert np.mean(losses[-5:]) < 0.98 * np.mean(losses[:5])
    assert metrics[0]["gradient_norm"] > 0 and metrics[0]["update_norm"] > 0
    squares = sum(np.square(leaf).sum() for leaf in jax.tree.leaves(weights))
    np.testing.assert_allclose(metrics[-1]["weight_norm"], np.sqrt(squares), rtol=1e-5)

    again = run(steps=2)[1]
    chex.assert_trees_all_equal(again, metrics[:2])
    assert run(steps=1, start=1)[1][0]["loss"] != losses[0]  # each step has its own rotations


def test_a_fraction_of_the_rotations_are_quarter_turns(config, make_batch):
    config = dataclasses.replace(config, quarter_turns=0.5)
    keys = jax.random.split(jax.random.key(0), 60)
    quarters = np.stack([_random_angles(key, config) for key in keys]) / (np.pi / 2)
    whole = np.abs(quarters - np.round(quarters)) < 1e-5
    assert 0.4 < whole.mean() < 0.6
    assert np.bincount(np.round(quarters[whole]).astype(int), minlength=4).min() > whole.sum() / 6
    assert np.ptp(np.histogram(quarters[~whole], bins=4, range=(0, 4))[0]) < (~whole).sum() / 6


GRID = Grid(resolution_m=1.0, height=64, width=48)
IMAGES = 400


def test_occluded_images_have_one_hidden_sector():
    shown = np.asarray(unoccluded_cells(jax.random.key(3), IMAGES, GRID, OcclusionConfig(share=0.5, widest_deg=180.0)))
    x, y = np.mgrid[: GRID.height, : GRID.width] + 0.5
    bearing = np.angle((x - GRID.height / 2) + 1j * (y - GRID.width / 2))
    of_bearing = ~shown[:, *np.unravel_index(np.argsort(bearing, axis=None), bearing.shape)]  # around the sensor
    assert ((of_bearing != np.roll(of_bearing, 1, axis=1)).sum(1) <= 2).all()  # one sector
    share = of_bearing.mean(1)
    chosen = share > 0.01
    assert 0.4 < chosen.mean() < 0.6 and 0.45 < share.max() < 0.53
    np.testing.assert_allclose(np.quantile(share[chosen], [0.25, 0.75]), [0.125, 0.375], atol=0.05)
    assert np.ptp([part.mean() for part in np.split(of_bearing[chosen], 4, axis=1)]) < 0.06  # each bearing as often


def test_hidden_cells_have_neither_counts_nor_labels(config, make_batch):
    batch = make_batch(0, images=True)
    batch = batch.replace(
        images=batch.images + 1, maps=np.ones(batch.images.shape, np.int32), labelled=np.ones(config.images, bool)
    )
    batch, config = jax.tree.map(jnp.asarray, batch), dataclasses.replace(config, rotate=False)
    angle_key, model_key = jax.random.split(jax.random.key(0))

    def chunk(occlusion):
        chunks = _network_input(batch, angle_key, model_key, dataclasses.replace(config, occlusion=occlusion))
        return np.asarray(chunks.images[0]), np.asarray(chunks.maps[0])

    whole, labels = chunk(OcclusionConfig())
    images, maps = chunk(OcclusionConfig(share=0.75))
    hidden = images == 0
    assert (whole > 0).all() and hidden.any((1, 2)).sum() >= 3 and not hidden.all((1, 2)).any()
    np.testing.assert_array_equal(images, np.where(hidden, 0, whole))
    np.testing.assert_array_equal(maps, np.where(hidden, UNLABELLED, labels))
    assert (labels != UNLABELLED).any()


MIXED = Batch(np.arange(8) >= 4, None, 1, images=np.zeros((4, 1, 1)), second=True)
"""Four places without labels, and four of a second batch."""


@pytest.mark.parametrize("every", [1, 2, 4])
def test_labelled_places_are_moved_to_segmented_positions_and_back(every):
    places = jnp.arange(8)
    order = in_network_order(places, MIXED, every=every)
    np.testing.assert_array_equal(in_batch_order(order, MIXED, every=every), places)
    seen = np.asarray(order)[::every]
    assert (seen >= 4).sum() == min(len(seen), 4)
    alone = MIXED.replace(second=None)
    np.testing.assert_array_equal(in_network_order(places, alone, every=every), places)
