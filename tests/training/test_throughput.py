"""The throughput of a run is that of all its steps together, the lines apart in which the step is compiled."""

import pytest

from sglpr_jax.training.throughput import throughput


def test_steps_and_waits_are_added_up():
    lines = [
        {"step": 10, "steps_per_second": 0.1, "data_wait": 0.9},
        {"step": 10, "score": 0.5},
        {"step": 20, "steps_per_second": 10.0, "data_wait": 0.5},  # a second, half of it waiting
        {"step": 50, "steps_per_second": 10.0, "data_wait": 0.0},  # three seconds
    ]
    found = throughput(lines)
    assert found is not None
    assert found.steps_per_second == pytest.approx(10)
    assert found.data_wait == pytest.approx(0.125)


def test_each_compilation_is_left_out():
    lines = [
        {"step": 10, "loss": 1.0},
        {"step": 20, "steps_per_second": 10.0, "data_wait": 0.5},
        {"step": 20, "score": 0.5},
        {"step": 30, "loss": 1.0},  # the first after a resume
        {"step": 50, "steps_per_second": 20.0, "data_wait": 0.0},
    ]
    found = throughput(lines)
    assert found is not None
    assert (found.steps_per_second, found.data_wait) == pytest.approx((15, 0.25))


@pytest.mark.parametrize(
    "lines", [[], [{"step": 4, "loss": 1.0}], [{"step": 4, "steps_per_second": 1.0, "data_wait": 0.1}]]
)
def test_a_run_that_only_compiled_has_none(lines):
    assert throughput(lines) is None
