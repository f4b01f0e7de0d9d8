"""The progress bar of one training after another."""

import pytest

from sglpr_jax.training.progress_bar import ProgressBar


@pytest.fixture
def terminal(monkeypatch):
    """Stderr counts as a terminal, so that there is a bar."""
    monkeypatch.setenv("FORCE_COLOR", "1")


@pytest.mark.usefixtures("terminal")
def test_a_bar_serves_a_second_training(capsys):
    bar = ProgressBar()
    for steps in (4, 7):
        bar.on_start(0, steps)
        bar.on_step(3, {"loss": 0.5})
        bar.close()
        assert f"3/{steps}" in capsys.readouterr().err


def test_without_a_terminal_there_is_a_line_a_call(capsys):
    bar = ProgressBar()
    bar.on_start(0, 4)
    assert capsys.readouterr().err == ""
    for step in (2, 4):
        bar.on_step(step, {"loss": 0.5, "steps_per_second": 3.0})
        assert capsys.readouterr().err == f"step {step} of 4: loss 0.5  steps_per_second 3\n"
    bar.close()
