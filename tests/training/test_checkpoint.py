"""Checkpoints come back bit by bit, the newest and the best stay, and those of another model are refused."""

import dataclasses
import json
import shutil
from types import SimpleNamespace

import chex
import jax
import jax.numpy as jnp
import pytest

from sglpr_jax.training.checkpoint import Checkpoints, set_damaged_aside
from sglpr_jax.training.checksums import NOT_COVERED
from sglpr_jax.training.state import TrainState, new_state


@pytest.fixture
def checkpoints(tmp_path):
    opened = Checkpoints(tmp_path / "checkpoints")
    yield opened
    opened.close()


@pytest.fixture(scope="module")
def state(config, params) -> TrainState:
    """A state in which no array is at its first value."""
    fresh = new_state(config, params=params)
    moments = jax.tree.map(lambda leaf: leaf + jnp.asarray(3, leaf.dtype), fresh.optimizer)
    return TrainState(jnp.int32(17), params, moments)


def test_a_state_comes_back_bit_by_bit(checkpoints, state, config):
    checkpoints.save(state, score=0.5)
    found = checkpoints.restore(config)
    chex.assert_trees_all_equal(found, state)
    assert found.params.config == config.model
    assert [leaf.dtype for leaf in jax.tree.leaves(found)] == [leaf.dtype for leaf in jax.tree.leaves(state)]


def test_what_is_saved_is_the_state_of_that_moment(checkpoints, state, config):
    """A step donates its state's buffers while the checkpoint of it may still be on its way to the disk."""
    next_step = jax.jit(lambda s: jax.tree.map(lambda leaf: leaf + jnp.asarray(1, leaf.dtype), s), donate_argnums=0)
    moving = jax.tree.map(jnp.copy, state)
    checkpoints.save(moving)
    for _ in range(5):
        moving = next_step(moving)
    chex.assert_trees_all_equal(checkpoints.restore(config), state)


@pytest.mark.slow
def test_the_two_newest_and_the_best_are_kept(checkpoints, state, config, tmp_path):
    for step, score in enumerate([0.1, 0.9, 0.2, 0.3, 0.4, None]):
        checkpoints.save(state.replace(step=jnp.int32(step)), score=score)
    assert checkpoints.latest_step() == 5
    assert checkpoints.restore(config).step == 5
    checkpoints.close()
    assert sorted(folder.name for folder in (tmp_path / "checkpoints").iterdir()) == ["1", "4", "5"]


@pytest.mark.slow
def test_the_best_is_still_known_after_a_resume(checkpoints, state, tmp_path):
    for step, score in enumerate([0.1, 0.9, 0.2, 0.3]):
        checkpoints.save(state.replace(step=jnp.int32(step)), score=score)
    checkpoints.close()
    resumed = Checkpoints(tmp_path / "checkpoints")
    for step, score in ((4, None), (5, 0.4)):
        resumed.save(state.replace(step=jnp.int32(step)), score=score)
    resumed.close()
    assert sorted(folder.name for folder in (tmp_path / "checkpoints").iterdir()) == ["1", "4", "5"]


def test_measurements_not_yet_logged_come_back_with_the_state(checkpoints, state):
    measured = [{"loss": 0.1 + 0.2, "dice": 1e-7}, {"loss": 1 / 3, "dice": 0.0}]
    checkpoints.save(state, unlogged=measured)
    assert checkpoints.unlogged() == measured
    checkpoints.save(state.replace(step=state.step + 1))
    assert checkpoints.unlogged() == []


def test_what_a_killed_process_left_half_written_or_half_deleted_is_swept(checkpoints, state, config, tmp_path):
    checkpoints.save(state)
    checkpoints.close()
    folder = tmp_path / "checkpoints"
    shutil.copytree(folder / "17", folder / "18.orbax-checkpoint-tmp")
    shutil.copytree(folder / "17" / "weights", folder / "outdated" / "3" / "weights")
    resumed = Checkpoints(folder)
    chex.assert_trees_all_equal(resumed.restore(config), state)
    resumed.close()
    assert [path.name for path in folder.iterdir()] == ["17"]


def test_a_disk_too_full_for_a_checkpoint_is_an_error_before_anything_is_written(
    checkpoints, state, config, tmp_path, monkeypatch
):
    checkpoints.save(state)
    with monkeypatch.context() as patch:
        patch.setattr(shutil, "disk_usage", lambda folder: SimpleNamespace(free=1000))
        message = rf"{tmp_path}/checkpoints: expected [\d,]+ bytes free .*, found 1,000; the last checkpoint is intact"
        with pytest.raises(OSError, match=message):
            checkpoints.save(state.replace(step=jnp.int32(18)))
    assert [path.name for path in (tmp_path / "checkpoints").iterdir()] == ["17"]
    chex.assert_trees_all_equal(checkpoints.restore(config), state)


def test_a_step_is_saved_once(checkpoints, state, config):
    checkpoints.save(state)
    checkpoints.save(dataclasses.replace(state, params=jax.tree.map(jnp.zeros_like, state.params)))
    chex.assert_trees_all_equal(checkpoints.restore(config), state)


@pytest.mark.parametrize(
    "change",
    [{"widths": (6,)}, {"widths": (4, 4), "strides": (1, 1), "means": (1, 1)}],
    ids=["other shapes", "other layers"],
)
def test_the_checkpoint_of_another_model_is_refused(checkpoints, state, config, change, tmp_path):
    checkpoints.save(state)
    backbone = dataclasses.replace(config.model.backbone, **change)
    other = dataclasses.replace(config, model=dataclasses.replace(config.model, backbone=backbone))
    with pytest.raises(ValueError, match=rf"{tmp_path}/checkpoints/17: not a checkpoint of this configuration"):
        checkpoints.restore(other)
    checkpoints.close()
    with pytest.raises(ValueError, match=r"expected [\w/]+ of shape .*, found "):
        Checkpoints(tmp_path / "checkpoints").restore(other)


def test_nothing_to_resume_from_is_an_error(checkpoints, config, tmp_path):
    assert checkpoints.latest_step() is None
    with pytest.raises(ValueError, match=rf"{tmp_path}/checkpoints: expected a checkpoint to resume from, found none"):
        checkpoints.restore(config)


@pytest.mark.slow
def test_the_best_weights_are_those_of_the_highest_score_after_a_resume_too(checkpoints, state, config, tmp_path):
    def plus(step: int):
        return jax.tree.map(lambda leaf: leaf + step, state.params.weights)

    for step, score in ((2, 0.4), (4, 0.9), (6, 0.7), (8, None)):
        params = state.params.replace(weights=plus(step))
        checkpoints.save(TrainState(jnp.int32(step), params, state.optimizer), score=score)
    chex.assert_trees_all_equal(checkpoints.best_params(config).weights, plus(4))
    resumed = Checkpoints(tmp_path / "checkpoints")
    resumed.save(TrainState(jnp.int32(10), state.params, state.optimizer), score=0.8)
    found = resumed.best_params(config)
    resumed.close()
    chex.assert_trees_all_equal(found.weights, plus(4))
    assert found.config == config.model
    assert sorted(int(folder.name) for folder in (tmp_path / "checkpoints").iterdir()) == [4, 8, 10]


def test_without_a_checkpoint_there_are_no_best_weights(checkpoints, config):
    with pytest.raises(ValueError, match="expected a checkpoint with a score, found none"):
        checkpoints.best_params(config)


FILES = ["weights/_METADATA", "weights/manifest.ocdbt", "optimizer/_sharding", "metrics/metrics", "unlogged/metadata"]


def saved(folder, state, *steps: int) -> None:
    opened = Checkpoints(folder)
    for step in steps:
        opened.save(state.replace(step=jnp.int32(step)), score=step / 10, unlogged=[{"loss": float(step)}])
    opened.close()


def flip(path, *, at: float = 0.5) -> None:
    content = bytearray(path.read_bytes())
    content[int(at * len(content))] ^= 1
    path.write_bytes(content)


@pytest.mark.parametrize("name", [*FILES, "weights/d/*", "optimizer/ocdbt.process_0/d/*", "checksums.json"])
def test_one_flipped_bit_is_found_the_checkpoint_set_aside_and_the_one_before_used(
    state, config, tmp_path, capfd, name
):
    folder = tmp_path / "checkpoints"
    saved(folder, state, 2, 4)
    damaged = min((folder / "4").glob(name))
    flip(damaged)
    resumed = Checkpoints(folder)
    chex.assert_trees_all_equal(resumed.restore(config), state.replace(step=jnp.int32(2)))
    assert resumed.unlogged() == [{"loss": 2.0}]
    chex.assert_trees_all_equal(resumed.best_params(config).weights, state.params.weights)
    resumed.close()
    said = capfd.readouterr().err
    assert f"damaged checkpoint {folder / '4'} set aside as damaged-4: " in said
    assert name == "checksums.json" or str(damaged) in said
    assert sorted(path.name for path in folder.iterdir()) == ["2", "damaged-4"]


@pytest.mark.parametrize("name", [*FILES, "checksums.json", "_CHECKPOINT_METADATA"])
@pytest.mark.parametrize("how", ["cut off", "gone"])
def test_a_file_that_is_cut_off_or_gone_is_found(state, config, tmp_path, capfd, name, how):
    folder = tmp_path / "checkpoints"
    saved(folder, state, 2, 4)
    path = folder / "4" / name
    content = path.read_bytes()
    path.unlink()
    if how == "cut off":
        path.write_bytes(content[: len(content) // 2])
    resumed = Checkpoints(folder)
    assert resumed.restore(config).step == 2
    resumed.close()
    assert str(path) in capfd.readouterr().err


def test_without_a_whole_checkpoint_there_is_one_error_and_nothing_is_renamed(state, tmp_path):
    folder = tmp_path / "checkpoints"
    saved(folder, state, 2, 4)
    for step in ("2", "4"):
        flip(folder / step / "weights" / "_METADATA")
    for _ in range(2):
        message = (
            rf"{folder}: expected a whole checkpoint, found 2 damaged: {folder}/4/weights/_METADATA: expected SHA-256"
        )
        with pytest.raises(ValueError, match=message):
            Checkpoints(folder)
    assert sorted(path.name for path in folder.iterdir()) == ["2", "4"]


def test_a_step_damaged_twice_is_set_aside_twice(state, config, tmp_path):
    folder = tmp_path / "checkpoints"
    saved(folder, state, 2)
    for _ in range(2):
        saved(folder, state, 4)
        flip(folder / "4" / "metrics" / "metrics")
        set_damaged_aside(folder)
    assert sorted(path.name for path in folder.iterdir()) == ["2", "damaged-4", "damaged-4-2"]


def test_every_file_has_a_checksum_but_those_that_orbax_writes_last(state, tmp_path):
    folder = tmp_path / "checkpoints"
    saved(folder, state, 2)
    there = {path.relative_to(folder / "2").as_posix() for path in (folder / "2").rglob("*") if path.is_file()}
    assert there == set(json.loads((folder / "2" / "checksums.json").read_text())) | set(NOT_COVERED)
