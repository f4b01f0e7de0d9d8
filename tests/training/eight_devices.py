"""Tests on eight devices. `test_devices.py` runs them in a process that has them."""

import dataclasses

import jax
import numpy as np
import pytest

from sglpr_jax.training import recipe, trainer
from sglpr_jax.training.devices import data_mesh
from sglpr_jax.training.metrics_log import read_metrics
from sglpr_jax.training.recipe import run_network
from sglpr_jax.training.trainer import METRICS_FILE

from .conftest import FAST_STEP, SWIN, Made


@pytest.fixture(scope="session")
def config(config):
    """Eight tuples of four places."""
    return dataclasses.replace(config, tuples=8)


def shared(batch):
    """Every place of the other tuples is a negative too."""
    others = ~np.eye(8, dtype=bool)
    return batch.replace(negatives=batch.negatives | np.repeat(others, 4, axis=1))


def assert_same_weights(found, expected):
    """Equal to float32 rounding; but nothing feels the bias of the keys, and Adam makes steps of its rounding."""
    for (path, a), b in zip(jax.tree_util.tree_leaves_with_path(found), jax.tree.leaves(expected), strict=True):
        if jax.tree_util.keystr(path, simple=True, separator="/").endswith("qkv/bias"):
            a, b = (np.asarray(x).reshape(3, -1)[[0, 2]] for x in (a, b))
        np.testing.assert_allclose(a, b, rtol=0, atol=1e-5)


def test_a_run_of_eight_devices_is_resumed_on_one(config, random_params, make_batch, monkeypatch, tmp_path):
    """With stochastic depth, chunks and shared negatives."""
    loss = dataclasses.replace(config.loss, segment_every=2)
    config = dataclasses.replace(config, model=SWIN, chunk=16, loss=loss, steps=4, score_every=100)
    params, batches = random_params(SWIN), Made(lambda step: shared(make_batch(step)))
    used = []

    def step(state, batch, *, network):
        new, metrics = FAST_STEP(state, batch, network=network)
        assert all(leaf.is_deleted() for leaf in jax.tree.leaves(state.params))
        assert all(leaf.sharding.is_fully_replicated for leaf in jax.tree.leaves(new))
        used.append({len(leaf.sharding.device_set) for leaf in jax.tree.leaves(new)})
        return new, metrics

    def score(params):
        assert {len(leaf.sharding.device_set) for leaf in jax.tree.leaves(params)} == {1}
        return {"score": float(sum(np.abs(leaf).sum() for leaf in jax.tree.leaves(params.weights)))}

    def run(folder, *, devices, stop=lambda: False):
        monkeypatch.setattr(recipe, "data_mesh", lambda c: data_mesh(c, jax.devices()[:devices]))
        options = {"score": score, "start_from": params, "resume": True, "stopped": stop}
        return run_network(config, batches, folder, **options).state

    monkeypatch.setattr(trainer, "train_step", step)
    whole = run(tmp_path / "whole", devices=1)
    checks = iter([False, True])
    assert run(tmp_path / "moved", devices=8, stop=lambda: next(checks)).step == 2
    moved = run(tmp_path / "moved", devices=1)
    assert used == [{1}] * 4 + [{8}] * 2 + [{1}] * 2
    assert_same_weights(moved.params.weights, whole.params.weights)
    logs = [read_metrics(tmp_path / name / METRICS_FILE) for name in ("moved", "whole")]
    assert [line["step"] for line in logs[0]] == [line["step"] for line in logs[1]] == [1, 2, 3, 4, 4]
    for found, expected in zip(*logs, strict=True):
        for name in expected.keys() - {"steps_per_second", "data_wait"}:
            np.testing.assert_allclose(found[name], expected[name], rtol=1e-4)


def test_the_mesh_has_the_largest_number_of_devices_that_divides_the_step(config, capsys):
    assert data_mesh(config).size == 8 and capsys.readouterr().err == ""
    for tuples, chunk, size in ((6, 0, 6), (20, 0, 5), (8, 4, 4), (1, 0, 1)):
        assert data_mesh(dataclasses.replace(config, tuples=tuples, chunk=chunk)).size == size
        assert f"using {size} of 8 devices" in capsys.readouterr().err
