"""The benchmarks: rasterising runs for real; those against PyTorch say so where it is not installed."""

import importlib
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

BENCHMARKS = Path(__file__).resolve().parents[1] / "benchmarks"


def test_rasterize_agrees_with_numpy_and_prints_ratios():
    options = ("--points", "2000", "--size", "32", "--repeats", "2", "--calls", "1", "--threads", "1")
    command = (sys.executable, BENCHMARKS / "rasterize.py", *options)
    done = subprocess.run(command, capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr
    assert "rasterize: largest difference 0" in done.stdout
    assert "rasterize_labels: largest difference 0" in done.stdout
    assert "JAX / numpy" in done.stdout
    assert "--points 2000" in done.stdout


@pytest.mark.parametrize("name", ["describe", "train_step"])
def test_missing_torch_is_one_clear_error(name, monkeypatch):
    monkeypatch.syspath_prepend(str(BENCHMARKS))
    monkeypatch.setitem(sys.modules, "torch", None)
    with pytest.raises(SystemExit, match=r"PyTorch.*pip install 'sglpr-jax\[torch\]'"):
        importlib.import_module(name).main()


def test_different_results_are_not_timed(monkeypatch):
    monkeypatch.syspath_prepend(str(BENCHMARKS))
    ratio = importlib.import_module("ratio")
    ratio.check_equal("same", np.array([1.0, 2.0]), np.array([1.0, 2.0]), tolerance=0)
    with pytest.raises(SystemExit, match="do not agree"):
        ratio.check_equal("unlike", np.array([1.0, 2.0]), np.array([1.0, 2.1]), tolerance=1e-3)
