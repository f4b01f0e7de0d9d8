"""A table entry is a term of the loss and a metric. Without a weight it is not computed."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from sglpr_jax.training import loss_terms
from sglpr_jax.training.batches import Batch
from sglpr_jax.training.config import LossConfig
from sglpr_jax.training.loss_terms import SegmentationTerm, Summary, joint_loss, segmentation_sums

UNIT = np.eye(8, dtype=np.float32)


def test_a_segmentation_term_is_summed_over_chunks_and_skipped_without_weight(make_batch, monkeypatch):
    def count(logits, classes, counted, config):
        return counted.sum()

    term = SegmentationTerm(lambda config: config.margin, count, lambda total, images: total / images)
    monkeypatch.setitem(loss_terms.SEGMENTATION_TERMS, "pixels", term)
    rng, config = np.random.default_rng(0), LossConfig(margin=2.0)
    logits = jnp.asarray(rng.normal(size=(8, 4, 4, 20)), jnp.float32)
    classes, counted = jnp.asarray(rng.integers(0, 20, (8, 4, 4))), jnp.asarray(rng.random((8, 4, 4)) < 0.5)
    assert set(segmentation_sums(logits, classes, counted, dataclasses.replace(config, margin=0.0))) == {
        "cross_entropy",
        "dice",
    }
    sums = segmentation_sums(logits, classes, counted, config)
    batch = make_batch(0, images=True).replace(labelled=np.arange(8) < 6)
    total, measured = joint_loss(Summary(jnp.asarray(UNIT), sums), batch, config)
    assert float(measured["pixels"]) == pytest.approx(float(counted.sum()) / 6)
    weights = {"triplet": 1.0, "cross_entropy": 0.4, "dice": 0.6, "pixels": 2.0}
    assert float(total) == pytest.approx(sum(weight * float(measured[name]) for name, weight in weights.items()))


@pytest.mark.parametrize("positives", [1, 2])
def test_positives_that_are_anchors_too_have_the_triplet_loss_of_numpy(positives):
    """Three tuples of an anchor with positives: each place has the others of its tuple as positives."""
    rng, config, size = np.random.default_rng(0), LossConfig(margin=0.5), 1 + positives
    descriptors = rng.normal(size=(3 * size, 5)).astype(np.float32)
    tuple_of = np.repeat(np.arange(3), size)
    apart = tuple_of[:, None] != tuple_of
    batch = Batch(np.zeros(3 * size, bool), apart, positives, anchors=size, images=descriptors)
    distances = np.linalg.norm(descriptors[:, None] - descriptors, axis=-1)
    closest = np.where(apart | np.eye(3 * size, dtype=bool), np.inf, distances).min(1)
    hardest = np.where(apart, distances, np.inf).min(1)
    expected = np.maximum(0.5 + closest - hardest, 0)
    found = jax.jit(loss_terms.triplet, static_argnames="config")(descriptors, batch, config=config)
    np.testing.assert_allclose(found, expected.mean(), rtol=1e-5)
    np.testing.assert_allclose(loss_terms.violations(jnp.asarray(descriptors), batch, config), (expected > 0).mean())
