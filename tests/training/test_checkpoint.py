"""Checkpoints are read bit by bit, the newest two are kept, and damaged or foreign ones are refused."""

import gc

import chex
import jax
import jax.numpy as jnp
import pytest

from sglpr_jax.training.checkpoint import Checkpoints
from sglpr_jax.training.image_network import ImageNetwork
from sglpr_jax.training.run_folder import checkpoint_steps
from sglpr_jax.training.step import TrainState

pytestmark = [
    pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning"),
    pytest.mark.filterwarnings("ignore:coroutine .* was never awaited:RuntimeWarning"),
]
"""A failed write of Orbax leaves others pending."""


@pytest.fixture(scope="module")
def state(config, params) -> TrainState:
    """A state in which no array is at its first value."""
    fresh = ImageNetwork(config).new_state(params)
    moments = jax.tree.map(lambda leaf: leaf + jnp.asarray(3, leaf.dtype), fresh.optimizer)
    return TrainState(jnp.int32(17), params, moments)


def at(state: TrainState, step: int) -> TrainState:
    return state.replace(step=jnp.int32(step))


def saved(folder, state, *steps) -> Checkpoints:
    opened = Checkpoints(folder)
    for step in steps:
        opened.save(at(state, step), {"unlogged": [{"loss": float(step)}]})
    return opened


def test_a_state_comes_back_bit_by_bit(state, tmp_path):
    about = {"unlogged": [{"loss": 0.1 + 0.2, "dice": 1e-7}, {"loss": 1 / 3, "dice": 0.0}], "images": 3}
    Checkpoints(tmp_path).save(state, about)
    found, told = Checkpoints(tmp_path).restore(state)
    chex.assert_trees_all_equal(found, state)
    assert found.params.config == state.params.config and told == about
    assert [leaf.dtype for leaf in jax.tree.leaves(found)] == [leaf.dtype for leaf in jax.tree.leaves(state)]


def test_the_two_newest_are_kept_after_a_resume_too_and_a_step_is_saved_once(state, tmp_path):
    saved(tmp_path, state, 0, 1, 2)
    assert checkpoint_steps(tmp_path) == [1, 2]
    resumed = saved(tmp_path, state, 4, 5)
    assert checkpoint_steps(tmp_path) == [4, 5] and resumed.latest_step == 5
    resumed.save(at(state, 5).replace(params=jax.tree.map(jnp.zeros_like, state.params)), {})
    chex.assert_trees_all_equal(resumed.restore(state)[0], at(state, 5))


def test_a_full_disk_leaves_the_earlier_checkpoint(state, tmp_path, small_files):
    checkpoints = saved(tmp_path, state, 2)
    with small_files(1000), pytest.raises(OSError, match=rf"{tmp_path}/4: cannot be written: "):
        checkpoints.save(at(state, 4), {})
    assert [path.name for path in tmp_path.iterdir()] == ["2"]
    gc.collect()  # here, not in a later test, Python reports the writes of Orbax that were pending


def test_missing_or_foreign_checkpoints_are_errors(state, tmp_path):
    with pytest.raises(ValueError, match=rf"{tmp_path}: expected a checkpoint to resume from, found none"):
        Checkpoints(tmp_path).restore(state)
    saved(tmp_path, state, 4)
    weights = dict(state.params.weights)
    name = min(weights)
    weights[name] = jax.tree.map(lambda leaf: leaf[None], weights[name])
    like = state.replace(params=state.params.replace(weights=weights))
    with pytest.raises(ValueError, match=rf"{tmp_path}/4: expected params/weights/{name}.* as .*, found"):
        Checkpoints(tmp_path).restore(like)


def damage(path, how: str) -> None:
    file = path / "about.json" if how == "about" else max(path.rglob("*/d/*"), key=lambda one: one.stat().st_size)
    content = bytearray(file.read_bytes())
    if how == "cut off":
        del content[len(content) // 2 :]
    else:
        content[content.index(b"loss") if how == "about" else len(content) // 2] ^= 1
    file.write_bytes(content)


@pytest.mark.parametrize("how", ["cut off", "about", "values"])
def test_a_damaged_checkpoint_is_renamed_and_the_previous_one_used(state, tmp_path, capfd, how):
    saved(tmp_path, state, 2, 4)
    damage(tmp_path / "4", how)
    found, about = Checkpoints(tmp_path).restore(state)
    chex.assert_trees_all_equal(found, at(state, 2))
    assert about["unlogged"] == [{"loss": 2.0}]
    said = capfd.readouterr().err
    assert f"damaged checkpoint set aside as damaged-4: {tmp_path}/4/" in said and "expected SHA-256" in said
    damage(tmp_path / "2", how)
    with pytest.raises(ValueError, match=rf"{tmp_path}: expected a whole checkpoint, found 1 damaged: {tmp_path}/2"):
        Checkpoints(tmp_path)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["2", "damaged-4"]
