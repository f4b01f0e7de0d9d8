"""A step in chunks is the step of the whole batch, and it learns."""

import dataclasses
import functools

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from sglpr_jax.models.sglpr import forward
from sglpr_jax.train.state import new_state
from sglpr_jax.train.step import Summary, _chunks, gradients, joint_loss, summarize, train_step


@functools.partial(jax.jit, static_argnames="config")
def gradients_of(params, batch, config):
    keys = jax.random.split(jax.random.key(0))
    return gradients(params, _chunks(batch, *keys, config), batch, config.loss)


def assert_same(found, expected):
    """Equal to float32 accuracy, measured against the largest value of each array."""
    for a, b in zip(jax.tree.leaves(found), jax.tree.leaves(expected), strict=True):
        np.testing.assert_allclose(a, b, rtol=0, atol=1e-5 * max(np.abs(b).max(), 1e-3))


@pytest.fixture(scope="module")
def whole(config, params, make_batch):
    return gradients_of(params, make_batch(0), config)


@pytest.mark.parametrize("chunk", [1, 4])
def test_chunks_give_the_gradient_and_metrics_of_the_whole_batch(config, params, make_batch, whole, chunk):
    gradient, metrics = gradients_of(params, make_batch(0), dataclasses.replace(config, chunk=chunk))
    assert set(metrics) == {"loss", "triplet", "cross_entropy", "dice", "violations"}
    assert_same(gradient, whole[0])
    assert_same(metrics, whole[1])
    assert all(np.abs(leaf).max() > 0 for leaf in jax.tree.leaves(gradient["segmentation_head"]))


@pytest.mark.parametrize("images", [False, True], ids=["points", "images"])
def test_without_labels_the_triplet_loss_is_all(config, params, make_batch, images):
    batch = make_batch(0, labels=False, images=images)
    gradient, metrics = gradients_of(params, batch, config)
    in_chunks = gradients_of(params, batch, dataclasses.replace(config, chunk=4))
    assert set(metrics) == {"loss", "triplet", "violations"}
    assert metrics["loss"] == metrics["triplet"] > 0
    assert_same(in_chunks, (gradient, metrics))
    assert np.abs(gradient["segmentation_head"]["kernel"]).max() == 0
    assert np.abs(gradient["place_head"]["netvlad"]["centres"]).max() > 0


def test_the_metrics_are_those_of_numpy(config, params, make_batch, whole):
    batch = make_batch(0)
    keys = jax.random.split(jax.random.key(0))
    chunks = _chunks(batch, *keys, config)
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
    overlap, total = ((2 * p * truth).sum((0, 1, 2)), (p**2 + truth**2).sum((0, 1, 2)))
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


def test_both_passes_over_a_chunk_drop_the_same_branches(config, params, make_batch):
    """With stochastic depth, too, the gradient is that of one function, in which every chunk has its own key."""
    config = dataclasses.replace(config, chunk=4, model=dataclasses.replace(config.model, drop_path=0.5))
    params, batch = dataclasses.replace(params, config=config.model), make_batch(0)

    @jax.jit
    def plain(params):
        chunks = _chunks(batch, *jax.random.split(jax.random.key(0)), config)

        def loss(weights):
            parts = [
                summarize(dataclasses.replace(params, weights=weights), jax.tree.map(lambda x, i=i: x[i], chunks))
                for i in range(config.images // config.chunk)
            ]
            merged = Summary(jnp.concatenate([p.descriptors for p in parts]), *map(sum, zip(*(p[1:] for p in parts))))  # noqa: B905
            return joint_loss(merged, batch, config.loss)

        return jax.grad(loss, has_aux=True)(params.weights)

    found = gradients_of(params, batch, config)
    assert_same(found, plain(params))
    still = gradients_of(
        dataclasses.replace(params, config=dataclasses.replace(config.model, drop_path=0.0)), batch, config
    )
    assert abs(float(found[1]["loss"] - still[1]["loss"])) > 1e-4


def test_a_violation_is_one_of_the_margin_under_the_smooth_loss_too(config, params, make_batch, whole):
    smooth = dataclasses.replace(config.loss, temperature=0.2, margin=-2.5)  # distances of unit vectors end at 2
    _, metrics = gradients_of(params, make_batch(0), dataclasses.replace(config, loss=smooth))
    assert metrics["violations"] == 0
    assert metrics["triplet"] > 0


def test_steps_on_one_batch_lower_its_loss_and_compile_once(config, params, make_batch):
    chex.clear_trace_counter()
    traced = chex.assert_max_traces(train_step.__wrapped__, n=1)
    step = jax.jit(traced, static_argnames="config", donate_argnames="state")
    state, batch = new_state(config, params=jax.tree.map(jnp.copy, params)), make_batch(0)
    config = dataclasses.replace(config, rotate=False)
    losses = []
    for expected_step in range(15):
        assert state.step == expected_step
        state, metrics = step(state, batch, config=config)
        losses.append(float(metrics["loss"]))
    assert losses[-1] < 0.9 * losses[0]
    assert metrics["gradient_norm"] > 0 and metrics["update_norm"] > 0
    np.testing.assert_allclose(
        metrics["weight_norm"],
        np.sqrt(sum((leaf**2).sum() for leaf in jax.tree.leaves(state.params.weights))),
        rtol=1e-5,
    )


def test_a_step_is_a_pure_function_whose_rotations_follow_seed_and_step(config, params, make_batch):
    batch = make_batch(0)

    def run(step, seed=0):
        state = new_state(config, params=jax.tree.map(jnp.copy, params)).replace(step=jnp.int32(step))
        state, metrics = train_step(state, batch, config=dataclasses.replace(config, seed=seed))
        return state.params.weights, metrics

    first = run(0)
    chex.assert_trees_all_equal(first, run(0))
    assert run(1)[1]["loss"] != first[1]["loss"]
    assert run(0, seed=1)[1]["loss"] != first[1]["loss"]
