"""Checkpoints come back bit by bit, the newest and the best stay, and damaged or foreign ones are refused."""

import chex
import jax
import jax.numpy as jnp
import pytest

from sglpr_jax.training.checkpoint import Checkpoints, checkpoint_steps, set_damaged_aside
from sglpr_jax.training.image_network import ImageNetwork
from sglpr_jax.training.step import TrainState


@pytest.fixture(scope="module")
def state(config, params) -> TrainState:
    """A state in which no array is at its first value."""
    fresh = ImageNetwork(config).new_state(params)
    moments = jax.tree.map(lambda leaf: leaf + jnp.asarray(3, leaf.dtype), fresh.optimizer)
    return TrainState(jnp.int32(17), params, moments)


def at(state: TrainState, step: int) -> TrainState:
    return state.replace(step=jnp.int32(step))


def saved(folder, state, scores) -> Checkpoints:
    opened = Checkpoints(folder)
    for step, score in scores.items():
        opened.save(at(state, step), score=score, about={"unlogged": [{"loss": float(step)}]})
    return opened


def test_a_state_comes_back_bit_by_bit(state, tmp_path):
    measured = [{"loss": 0.1 + 0.2, "dice": 1e-7}, {"loss": 1 / 3, "dice": 0.0}]
    Checkpoints(tmp_path).save(state, score=0.5, about={"unlogged": measured})
    found, about = Checkpoints(tmp_path).restore(state)
    chex.assert_trees_all_equal(found, state)
    assert found.params.config == state.params.config
    assert [leaf.dtype for leaf in jax.tree.leaves(found)] == [leaf.dtype for leaf in jax.tree.leaves(state)]
    assert about == {"unlogged": measured, "score": 0.5}


def test_the_two_newest_and_the_best_are_kept_after_a_resume_too(state, tmp_path):
    saved(tmp_path, state, {0: 0.1, 1: 0.9, 2: 0.2, 3: 0.3})
    assert checkpoint_steps(tmp_path) == [1, 2, 3]
    resumed = saved(tmp_path, state, {4: None, 5: 0.4})
    assert resumed.latest_step == 5 and resumed.restore(state)[0].step == 5
    assert resumed.best(state).step == 1
    assert checkpoint_steps(tmp_path) == [1, 4, 5]
    resumed.save(at(state, 6), score=0.9)
    assert resumed.best(state).step == 6  # the later one of equal scores


def test_a_step_is_saved_once(state, tmp_path):
    checkpoints = Checkpoints(tmp_path)
    checkpoints.save(state)
    checkpoints.save(state.replace(params=jax.tree.map(jnp.zeros_like, state.params)))
    chex.assert_trees_all_equal(checkpoints.restore(state)[0], state)


@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")  # writes of Orbax that were pending
@pytest.mark.filterwarnings("ignore:coroutine .* was never awaited:RuntimeWarning")
def test_a_full_disk_leaves_the_earlier_checkpoint(state, tmp_path, small_files):
    checkpoints = saved(tmp_path, state, {2: 0.1})
    with small_files(1000), pytest.raises(OSError, match=rf"{tmp_path}/4: cannot be written: "):
        checkpoints.save(at(state, 4))
    assert [path.name for path in tmp_path.iterdir()] == ["2"]


@pytest.mark.parametrize("other", ["other shapes", "missing"])
def test_the_checkpoint_of_another_model_is_refused(state, tmp_path, other):
    saved(tmp_path, state, {4: None})
    weights = dict(state.params.weights)
    name = min(weights)
    del weights[name]
    if other == "other shapes":
        weights[name] = jax.tree.map(lambda leaf: leaf[None], state.params.weights[name])
    like = state.replace(params=state.params.replace(weights=weights))
    with pytest.raises(ValueError, match=rf"{tmp_path}/4: expected params/weights/{name}.* as .*, found"):
        Checkpoints(tmp_path).restore(like)


def test_nothing_to_resume_from_is_an_error(state, tmp_path):
    checkpoints = Checkpoints(tmp_path)
    assert checkpoints.latest_step is None
    with pytest.raises(ValueError, match=rf"{tmp_path}: expected a checkpoint to resume from, found none"):
        checkpoints.restore(state)
    with pytest.raises(ValueError, match="expected a checkpoint with a score, found none"):
        checkpoints.best(state)


def damage(path, how: str) -> None:
    file = path / "about.json" if how == "about" else max(path.rglob("*/d/*"), key=lambda one: one.stat().st_size)
    content = bytearray(file.read_bytes())
    if how == "cut off":
        del content[len(content) // 2 :]
    else:
        content[content.index(b"0.4") if how == "about" else len(content) // 2] ^= 1
    file.write_bytes(content)


@pytest.mark.parametrize("how", ["cut off", "about", "values"])
def test_a_damaged_checkpoint_is_set_aside_and_the_one_before_used(state, tmp_path, capfd, how):
    for aside in (["damaged-4"], ["damaged-4", "damaged-4-2"]):
        saved(tmp_path, state, {2: 0.2, 4: 0.4})
        damage(tmp_path / "4", how)
        resumed = Checkpoints(tmp_path)
        found, about = resumed.restore(state)
        chex.assert_trees_all_equal(found, at(state, 2))
        assert about["unlogged"] == [{"loss": 2.0}] and resumed.best(state).step == 2
        said = capfd.readouterr().err
        assert f"damaged checkpoint set aside as {aside[-1]}: {tmp_path / '4'}/" in said and "expected SHA-256" in said
        assert sorted(path.name for path in tmp_path.iterdir()) == ["2", *aside]


def test_without_a_whole_checkpoint_there_is_one_error_and_nothing_is_renamed(state, tmp_path):
    saved(tmp_path, state, {2: None, 4: None})
    for step in (2, 4):
        damage(tmp_path / f"{step}", "values")
    message = rf"{tmp_path}: expected a whole checkpoint, found 2 damaged: {tmp_path}/4/.*: expected SHA-256"
    with pytest.raises(ValueError, match=message):
        set_damaged_aside(tmp_path)
    assert checkpoint_steps(tmp_path) == [2, 4]
