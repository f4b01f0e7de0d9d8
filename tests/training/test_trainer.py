"""A resumed run ends with the weights and the logs of an uninterrupted one, bit by bit."""

import dataclasses
from collections.abc import Callable
from pathlib import Path

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from sglpr_jax.training import trainer
from sglpr_jax.training.callbacks import Callback, Callbacks
from sglpr_jax.training.checkpoint import Checkpoints
from sglpr_jax.training.image_network import ImageNetwork
from sglpr_jax.training.metrics_log import read_metrics
from sglpr_jax.training.recipe import run_network
from sglpr_jax.training.run_folder import CHECKPOINTS
from sglpr_jax.training.step import TrainState
from sglpr_jax.training.trainer import METRICS_FILE, Schedule, Trained

from .conftest import FAST_STEP, Made

TIMES = {"steps_per_second", "data_wait"}


def size_of_weights(params) -> dict[str, float]:
    return {"score": float(sum(np.abs(leaf).sum() for leaf in jax.tree.leaves(params.weights)))}


def after(checks: int) -> Callable[[], bool]:
    """Says yes from the given check on; the loop checks once a step."""
    left = iter(range(checks - 1))
    return lambda: next(left, None) is None


def logged(folder: Path) -> list[dict]:
    """The measurements without those of time."""
    return [{k: v for k, v in line.items() if k not in TIMES} for line in read_metrics(folder / METRICS_FILE)]


@pytest.fixture
def run(config, params, make_batch, tmp_path):
    """Trains from ready-made weights and returns the state; compiling the network's `init` takes seconds."""

    def train(folder: Path = tmp_path, *, change=None, make=make_batch, score=size_of_weights, **options) -> TrainState:
        changed = dataclasses.replace(config, **(change or {}))
        source = make if isinstance(make, Made) else Made(make)
        return run_network(changed, source, folder, score=score, start_from=params, **options).state

    return train


@pytest.fixture
def fast_step(monkeypatch):
    """The real step, compiled in a third of the time."""
    monkeypatch.setattr(trainer, "train_step", FAST_STEP)


@pytest.fixture
def fake_step(monkeypatch):
    """A step that only counts; its loss is the step's number, and not finite in the step before `broken`."""

    def install(*, broken: int | None = None) -> None:
        def step(state: TrainState, batch, *, network):
            done = int(state.step) + 1
            loss = jnp.float32(np.nan if done == broken else done)
            return state.replace(step=jnp.int32(done)), {"loss": loss, "dice": jnp.float32(1)}

        monkeypatch.setattr(trainer, "train_step", step)

    install()
    return install


@pytest.mark.slow
@pytest.mark.usefixtures("fast_step")
def test_a_resumed_run_equals_an_uninterrupted_one_even_after_a_damaged_checkpoint(run, config, tmp_path, capfd):
    folders = [tmp_path / name for name in ("whole", "resumed")]
    whole, stopped = run(folders[0]), run(folders[1], stopped=after(5))
    assert (whole.step, stopped.step) == (config.steps, 5)
    assert logged(folders[1]) == logged(folders[0])[:7]  # five steps and two scores
    damaged = max((folders[1] / CHECKPOINTS / "5").rglob("*/d/*"), key=lambda one: one.stat().st_size)
    content = bytearray(damaged.read_bytes())
    content[len(content) // 2] ^= 1
    damaged.write_bytes(content)
    chex.assert_trees_all_equal(run(folders[1], resume=True), whole)
    assert str(damaged) in capfd.readouterr().err
    assert logged(folders[1]) == logged(folders[0])
    assert [line["step"] for line in logged(folders[0])] == [1, 2, 2, 3, 4, 4, 5, 6, 6]
    chex.assert_trees_all_equal(run(folders[1], resume=True), whole)  # it is finished
    assert logged(folders[1]) == logged(folders[0])


@pytest.mark.usefixtures("fake_step")
def test_a_stop_between_two_lines_does_not_change_the_log(run, tmp_path):
    change = {"steps": 12, "log_every": 5, "score_every": 8}
    folders = [tmp_path / name for name in ("whole", "resumed")]
    run(folders[0], change=change)
    stops = []
    while not stops or stops[-1] < 12:  # by twos: some between lines, some at one
        stops.append(int(run(folders[1], change=change, resume=bool(stops), stopped=after(2)).step))
    assert stops == [2, 4, 6, 8, 10, 12]
    timed = [line.keys() >= TIMES for line in read_metrics(folders[1] / METRICS_FILE) if "loss" in line]
    assert timed == [False] * 4  # the first line of a process states no speed
    assert logged(folders[1]) == logged(folders[0])
    losses = [(line["step"], line["loss"]) for line in logged(folders[0]) if "loss" in line]
    assert losses == [(5, 3), (8, 7), (10, 9.5), (12, 11.5)]  # means since the last line


def test_a_loss_that_is_not_finite_ends_the_run_at_its_step(run, config, make_batch, fake_step, params, tmp_path):
    fake_step(broken=3)
    words = r"^step 3: loss not finite \(batch: the one read for 2\); the last checkpoint is intact$"
    with pytest.raises(FloatingPointError, match=words):
        run(make=Made(make_batch, scan_names="the one read for {}".format))
    assert [line["step"] for line in logged(tmp_path)] == [1, 2, 2]
    like = jax.eval_shape(ImageNetwork(config).new_state)
    found, _ = Checkpoints(tmp_path / CHECKPOINTS).restore(like)
    assert found.step == 2
    chex.assert_trees_all_equal(found.params, params)


@pytest.mark.usefixtures("fake_step")
def test_a_callback_receives_all_measurements(run, tmp_path):
    told = []

    class Told(Callback):
        def on_start(self, step, steps):
            told.append(("from", step, steps))

        def on_step(self, step, values):
            told.append({"step": step, **values})

        on_score = on_step

    run(callback=Callbacks(Callback(), Told()))
    assert [line for line in told if isinstance(line, dict)] == read_metrics(tmp_path / METRICS_FILE)
    assert [line for line in told if not isinstance(line, dict)] == [("from", 0, 6)]


@pytest.mark.usefixtures("fake_step")
def test_a_batch_that_cannot_be_read_ends_the_run_with_its_own_error(run, make_batch, config, tmp_path):
    def make(step):
        if step == 2:
            raise ValueError("000007.bin: not a whole scan")
        return make_batch(step)

    with pytest.raises(ValueError, match=r"000007\.bin: not a whole scan"):
        run(make=make)
    assert [line["step"] for line in logged(tmp_path)] == [1, 2, 2]
    assert run(resume=True).step == config.steps


def test_limits_and_snapshots():
    state = TrainState(np.int32(7), {}, {})
    schedule = Schedule(10, score_every=5, first_snapshot=100, steps=9, images=900, seconds=60.0)
    assert not schedule.is_over(Trained(state, 899, 59.9))
    for images, seconds, steps in ((900, 0.0, 7), (0, 60.0, 7), (0, 0.0, 9)):
        assert schedule.is_over(Trained(state.replace(step=np.int32(steps)), images, seconds))
    assert list(schedule.snapshots(Trained(state, 90), Trained(state, 450))) == [100, 200, 400]
    assert list(schedule.snapshots(Trained(state, 400), Trained(state, 450))) == []
    assert schedule.is_scored(Trained(state, 90), Trained(state, 100))
    assert not schedule.is_scored(Trained(state, 100), Trained(state, 110))
    assert schedule.is_scored(Trained(state, 0), Trained(state.replace(step=np.int32(5)), 0))
