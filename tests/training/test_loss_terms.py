"""A table entry is a term of the loss and a metric. Without a weight it is not computed."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest

from sglpr_jax.training import loss_terms
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
