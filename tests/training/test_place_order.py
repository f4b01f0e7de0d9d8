"""A mixed batch learns places from one source and semantics from the labelled other, in whatever order."""

import dataclasses
import functools

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from sglpr_jax.data.sampling.mixing import mix
from sglpr_jax.training.place_order import in_batch_order, in_network_order
from sglpr_jax.training.step import _chunks, gradients

FAST_COMPILE = {"xla_backend_optimization_level": 0}


@functools.partial(jax.jit, static_argnames="config", compiler_options=FAST_COMPILE)
def gradients_of(params, batch, config):
    chunks = _chunks(batch, *jax.random.split(jax.random.key(0)), config)
    return gradients(params, chunks, batch, config.loss)


def assert_same(found, expected):
    """Equal to float32 accuracy, measured against the largest value of each array."""
    for a, b in zip(jax.tree.leaves(found), jax.tree.leaves(expected), strict=True):
        np.testing.assert_allclose(a, b, rtol=0, atol=1e-4 * np.abs(b).max() + 1e-7)


def half(batch, rows: slice, tuples: slice):
    """Some tuples of a batch, alone."""
    cut = {
        name: None if value is None else value[rows]
        for name, value in ((n, getattr(batch, n)) for n in ("labelled", "images", "points", "count", "classes"))
    }
    return batch.replace(negatives=batch.negatives[tuples, rows], **cut)


@pytest.fixture
def mixed(make_batch):
    """A tuple of images and one of scans, of which one has no labels; the scans count for the segmentation alone."""
    images = half(make_batch(0, images=True), slice(0, 4), slice(0, 1))
    scans = half(make_batch(1), slice(4, 8), slice(1, 2))
    return mix(images, scans, triplets=False, share_negatives=False)


@pytest.mark.parametrize("every", [1, 2, 4])
def test_labelled_places_come_where_the_segmentation_head_looks_and_go_back(mixed, every):
    places = jnp.arange(8)
    order = in_network_order(places, mixed, every=every)
    np.testing.assert_array_equal(in_batch_order(order, mixed, every=every), places)
    seen = np.asarray(order)[::every]
    assert (seen >= 4).sum() == min(len(seen), 4)
    alone = mixed.replace(also=None)
    np.testing.assert_array_equal(in_network_order(places, alone, every=every), places)


@pytest.mark.slow
def test_the_segmentation_learns_from_labelled_places_alone_and_the_triplet_loss_from_its_own(mixed, config, params):
    assert mixed.labelled.sum() == 3
    gradient, metrics = gradients_of(params, mixed, config)
    assert np.abs(gradient["segmentation_head"]["kernel"]).max() > 1e-3
    assert metrics["cross_entropy"] > 0 and metrics["triplet"] > 0

    def segmentation_gradient(batch):
        return gradients_of(params, batch, config)[0]["segmentation_head"]["kernel"]

    other_images = mixed.replace(images=mixed.images[::-1].copy())
    np.testing.assert_array_equal(segmentation_gradient(other_images), gradient["segmentation_head"]["kernel"])
    unlabelled = np.flatnonzero(~mixed.labelled[4:])
    points = mixed.also.points.copy()
    points[unlabelled] += 3
    other_scan = mixed.replace(also=mixed.also.replace(points=points))
    np.testing.assert_array_equal(segmentation_gradient(other_scan), gradient["segmentation_head"]["kernel"])
    classes = (mixed.also.classes + 1) % 20
    relabelled = mixed.replace(also=mixed.also.replace(classes=classes))
    assert np.abs(segmentation_gradient(relabelled) - gradient["segmentation_head"]["kernel"]).max() > 1e-4
    assert gradients_of(params, relabelled, config)[1]["triplet"] == metrics["triplet"]


def test_both_losses_reach_the_shared_features(mixed, config, params):
    only_places = mixed.replace(labelled=np.zeros(8, bool))
    only_semantics = mixed.replace(negatives=np.zeros_like(mixed.negatives))
    for batch in (only_places, only_semantics):
        gradient, _ = gradients_of(params, batch, config)
        assert np.abs(gradient["rings"]["block_0"]["convolution"]["kernel"]).max() > 1e-4


@pytest.mark.slow
def test_the_order_changes_nothing_but_who_is_segmented(mixed, config, params):
    every = dataclasses.replace(config, loss=dataclasses.replace(config.loss, segment_every=2))
    expected, found = gradients_of(params, mixed, config), gradients_of(params, mixed, every)
    assert_same(found, expected)  # four of the eight images are segmented: those that could have labels
    assert_same(gradients_of(params, mixed, dataclasses.replace(every, chunk=4)), expected)


@pytest.mark.slow
def test_images_with_scans_that_count_as_tuples_too(make_batch, config, params):
    images = half(make_batch(0, images=True), slice(0, 4), slice(0, 1))
    scans = half(make_batch(1), slice(4, 8), slice(1, 2))
    both = mix(images, scans, triplets=True, share_negatives=False)
    _, metrics = gradients_of(params, both, config)
    alone = mix(images, scans, triplets=False, share_negatives=False)
    first = gradients_of(params, alone, config)[1]["triplet"]
    only_second = both.replace(negatives=both.negatives & np.array([[False], [True]]))
    second = gradients_of(params, only_second, config)[1]["triplet"]
    np.testing.assert_allclose(metrics["triplet"], (first + 2 * second) / 2, rtol=1e-5)
    chex.assert_tree_all_finite(metrics)
