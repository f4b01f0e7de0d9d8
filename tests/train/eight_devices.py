"""Tests for eight devices, which `test_devices.py` runs in a process that has them."""

import dataclasses

import jax
import numpy as np
import pytest

from sglpr_jax.train.devices import data_mesh, own_copy, replicate, split
from sglpr_jax.train.state import new_state
from sglpr_jax.train.step import train_step

STEP = jax.jit(
    train_step.__wrapped__,
    static_argnames="config",
    donate_argnames="state",
    compiler_options={"xla_backend_optimization_level": 0},
)


@pytest.fixture(scope="session")
def config(config):
    """Eight tuples of four places, with stochastic depth."""
    return dataclasses.replace(config, tuples=8, model=dataclasses.replace(config.model, drop_path=0.3))


def shared(batch):
    """Every place of the other tuples is a negative too."""
    others = ~np.eye(8, dtype=bool)
    return batch.replace(far=batch.far | np.repeat(others, 4, axis=1))


def make_steps(config, params, batches, devices):
    """The weights after some steps and the measurements of each."""
    mesh = data_mesh(config, devices)
    state = replicate(new_state(config, params=params), mesh)
    measured = []
    for batch in batches:
        before = state
        with jax.set_mesh(mesh):
            state, metrics = STEP(before, split(batch, mesh), config=config)
        measured.append(jax.device_get(metrics))
        assert all(leaf.is_deleted() for leaf in jax.tree.leaves(before.params))
    for leaf in jax.tree.leaves(state):
        assert leaf.sharding.is_fully_replicated and len(leaf.sharding.device_set) == len(devices)
    return jax.device_get(own_copy(state.params.weights)), measured


@pytest.mark.parametrize("kind", ["labels", "labels and shared negatives", "chunks", "images"])
def test_eight_devices_make_the_steps_of_one(config, params, make_batch, kind):
    batches = [make_batch(step, labels=kind != "images", images=kind == "images") for step in range(3)]
    if kind == "labels and shared negatives":
        batches = [shared(batch) for batch in batches]
    if kind == "chunks":
        config = dataclasses.replace(config, chunk=16, loss=dataclasses.replace(config.loss, segment_every=2))
    one = make_steps(config, params, batches, jax.devices()[:1])
    eight = make_steps(config, params, batches, jax.devices())
    for i in range(3):
        print(kind, i, {k: (float(one[1][i][k]), float(eight[1][i][k]) - float(one[1][i][k])) for k in one[1][i]})
    dw = jax.tree.map(
        lambda a, b, c: (np.abs(a - b).max(), np.linalg.norm(a - b), np.linalg.norm(a - c)),
        eight[0],
        one[0],
        jax.device_get(params.weights),
    )
    for k, v in jax.tree_util.tree_leaves_with_path(dw, is_leaf=lambda x: isinstance(x, tuple)):
        print(jax.tree_util.keystr(k), v)
