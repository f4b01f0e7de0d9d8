"""A run that was stopped and resumed ends where an uninterrupted one ends, to the bit."""

import dataclasses
from collections.abc import Callable
from pathlib import Path

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from sglpr_jax.training import loop
from sglpr_jax.training.callbacks import Callback, Callbacks
from sglpr_jax.training.checkpoint import Checkpoints
from sglpr_jax.training.loop import CHECKPOINTS, METRICS_FILE, run_steps
from sglpr_jax.training.metrics_log import read_metrics
from sglpr_jax.training.state import TrainState, new_state
from sglpr_jax.training.step import train_step

from .conftest import Made

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
def from_params(monkeypatch, params):
    """New runs begin with ready-made weights; compiling the network's `init` takes seconds."""
    monkeypatch.setattr(loop, "new_state", lambda c, **_: new_state(c, params=jax.tree.map(jnp.copy, params)))


@pytest.fixture
def fast_step(monkeypatch, from_params):
    """The real step, compiled in a third of the time."""
    step = jax.jit(
        train_step.__wrapped__,
        static_argnames="config",
        donate_argnames="state",
        compiler_options={"xla_backend_optimization_level": 0},
    )
    monkeypatch.setattr(loop, "train_step", step)


@pytest.fixture
def fake_step(monkeypatch, from_params):
    """A step that only counts; its loss is the step's number, and not finite in the step before `broken`."""

    def install(*, broken: int | None = None) -> None:
        def step(state: TrainState, batch, *, config):
            done = int(state.step) + 1
            loss = jnp.float32(np.nan if done == broken else done)
            return state.replace(step=jnp.int32(done)), {"loss": loss, "dice": jnp.float32(1)}

        monkeypatch.setattr(loop, "train_step", step)

    return install


@pytest.mark.slow
def test_stopped_and_resumed_is_uninterrupted(config, make_batch, fast_step, tmp_path):
    folders = tmp_path / "whole", tmp_path / "resumed"
    whole = run_steps(config, Made(make_batch), folders[0], score=size_of_weights)
    stopped = run_steps(config, Made(make_batch), folders[1], score=size_of_weights, stopped=after(3))
    assert (whole.step, stopped.step) == (config.steps, 3)
    assert logged(folders[1]) == logged(folders[0])[:4]  # three steps and the score after the second
    resumed = run_steps(config, Made(make_batch), folders[1], score=size_of_weights, resume=True)
    chex.assert_trees_all_equal(resumed, whole)
    assert logged(folders[1]) == logged(folders[0])
    assert [line["step"] for line in logged(folders[0])] == [1, 2, 2, 3, 4, 4, 5, 6, 6]

    finished = run_steps(config, Made(make_batch), folders[1], score=size_of_weights, resume=True)
    chex.assert_trees_all_equal(finished, whole)
    assert logged(folders[1]) == logged(folders[0])


@pytest.mark.slow
def test_a_run_resumed_past_a_damaged_checkpoint_is_uninterrupted(config, make_batch, fast_step, tmp_path, capfd):
    folders = tmp_path / "whole", tmp_path / "resumed"
    whole = run_steps(config, Made(make_batch), folders[0], score=size_of_weights)
    run_steps(config, Made(make_batch), folders[1], score=size_of_weights, stopped=after(5))
    damaged = min((folders[1] / CHECKPOINTS / "5" / "weights" / "d").iterdir())
    content = bytearray(damaged.read_bytes())
    content[len(content) // 2] ^= 1
    damaged.write_bytes(content)
    resumed = run_steps(config, Made(make_batch), folders[1], score=size_of_weights, resume=True)
    assert str(damaged) in capfd.readouterr().err
    chex.assert_trees_all_equal(resumed, whole)
    assert logged(folders[1]) == logged(folders[0])


@pytest.mark.slow
def test_a_stop_between_two_lines_of_the_log_leaves_no_trace_in_it(config, make_batch, fake_step, tmp_path):
    fake_step()
    config = dataclasses.replace(config, steps=12, log_every=5, score_every=8)
    folders = tmp_path / "whole", tmp_path / "resumed"
    run_steps(config, Made(make_batch), folders[0], score=size_of_weights)
    stops = []
    while not stops or stops[-1] < config.steps:  # by twos: some between lines, some at one
        state = run_steps(
            config, Made(make_batch), folders[1], score=size_of_weights, resume=bool(stops), stopped=after(2)
        )
        stops.append(int(state.step))
    assert stops == [2, 4, 6, 8, 10, 12]
    assert logged(folders[1]) == logged(folders[0])
    losses = [(line["step"], line["loss"]) for line in logged(folders[0]) if "loss" in line]
    assert losses == [(5, 3), (8, 7), (10, 9.5), (12, 11.5)]


@pytest.mark.slow
def test_the_first_line_after_each_start_says_nothing_of_time(config, make_batch, fake_step, tmp_path):
    fake_step()
    run_steps(config, Made(make_batch), tmp_path, score=size_of_weights, stopped=after(3))
    run_steps(config, Made(make_batch), tmp_path, score=size_of_weights, resume=True)
    lines = [line for line in read_metrics(tmp_path / METRICS_FILE) if "loss" in line]
    assert [line["step"] for line in lines if line.keys() > TIMES] == [2, 3, 5, 6]
    assert not [line for line in lines if line["step"] in (1, 4) and TIMES & line.keys()]


def test_measurements_are_means_since_the_last_line(config, make_batch, fake_step, tmp_path):
    fake_step()
    config = dataclasses.replace(config, steps=7, log_every=3, score_every=100)
    run_steps(config, Made(make_batch), tmp_path, score=size_of_weights)
    losses = [(line["step"], line["loss"]) for line in logged(tmp_path) if "loss" in line]
    assert losses == [(3, 2), (6, 5), (7, 7)]


def test_a_loss_that_is_not_finite_ends_the_run_at_its_step(config, make_batch, fake_step, params, tmp_path):
    fake_step(broken=3)
    with pytest.raises(FloatingPointError, match=r"^step 3: loss not finite; the last checkpoint is intact$"):
        run_steps(config, Made(make_batch), tmp_path, score=size_of_weights)
    assert [line["step"] for line in logged(tmp_path)] == [1, 2, 2]
    checkpoints = Checkpoints(tmp_path / CHECKPOINTS)
    found = checkpoints.restore(config)
    checkpoints.close()
    assert found.step == 2
    chex.assert_trees_all_equal(found.params, params)


def test_the_batch_of_a_broken_step_is_named(config, make_batch, fake_step, tmp_path):
    fake_step(broken=3)
    words = r"^step 3: loss not finite \(batch: the one read for 2\); the last checkpoint is intact$"
    with pytest.raises(FloatingPointError, match=words):
        run_steps(config, Made(make_batch, places="the one read for {}".format), tmp_path, score=size_of_weights)


def test_a_callback_gets_all_that_is_measured(config, make_batch, fake_step, tmp_path):
    fake_step()
    told = []

    class Told(Callback):
        def on_start(self, step, steps):
            told.append(("from", step, steps))

        def on_step(self, step, values):
            told.append({"step": step, **values})

        on_score = on_step

        def on_checkpoint(self, step):
            told.append(step)

    run_steps(config, Made(make_batch), tmp_path, score=size_of_weights, callback=Callbacks(Callback(), Told()))
    assert [line for line in told if isinstance(line, dict)] == read_metrics(tmp_path / METRICS_FILE)
    assert [line for line in told if not isinstance(line, dict)] == [("from", 0, 6), 2, 4, 6]


@pytest.mark.slow
def test_a_batch_that_cannot_be_read_ends_the_run_with_its_own_error(config, make_batch, fake_step, tmp_path):
    fake_step()

    def make(step):
        if step == 2:
            raise ValueError("000007.bin: not a whole scan")
        return make_batch(step)

    with pytest.raises(ValueError, match=r"000007\.bin: not a whole scan"):
        run_steps(config, Made(make), tmp_path, score=size_of_weights)
    assert [line["step"] for line in logged(tmp_path)] == [1, 2, 2]
    resumed = run_steps(config, Made(make_batch), tmp_path, score=size_of_weights, resume=True)
    assert resumed.step == config.steps
    assert [line["step"] for line in logged(tmp_path)] == [1, 2, 2, 3, 4, 4, 5, 6, 6]


@pytest.mark.slow
def test_the_score_decides_which_checkpoint_is_the_best(config, make_batch, fake_step, tmp_path):
    fake_step()
    scores = iter([0.1, 0.9, 0.3, 0.2, 0.5])
    config = dataclasses.replace(config, steps=10)
    run_steps(config, Made(make_batch), tmp_path, score=lambda params: {"score": next(scores), "loss_elsewhere": 1.0})
    kept = sorted(int(folder.name) for folder in (tmp_path / CHECKPOINTS).iterdir())
    assert kept == [4, 8, 10]
    assert [line["score"] for line in logged(tmp_path) if "score" in line] == [0.1, 0.9, 0.3, 0.2, 0.5]


def test_resuming_before_the_first_checkpoint_starts_from_the_beginning(config, make_batch, fake_step, tmp_path):
    fake_step(broken=2)
    with pytest.raises(FloatingPointError, match=r"^step 2"):
        run_steps(config, Made(make_batch), tmp_path, score=size_of_weights)
    fake_step()
    assert run_steps(config, Made(make_batch), tmp_path, score=size_of_weights, resume=True).step == config.steps
    assert [line["step"] for line in logged(tmp_path)] == [1, 2, 2, 3, 4, 4, 5, 6, 6]
