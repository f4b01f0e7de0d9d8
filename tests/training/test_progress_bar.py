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
