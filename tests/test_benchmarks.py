"""The benchmarks run for real; those against PyTorch say so where it is not installed."""

import importlib
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from sglpr_jax.sim import Sensor, write_dataset

BENCHMARKS = Path(__file__).resolve().parents[1] / "benchmarks"


def printed(benchmark: str, *options: str) -> str:
    command = (sys.executable, BENCHMARKS / benchmark, *options)
    done = subprocess.run(command, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_rasterize_agrees_with_numpy_and_prints_ratios():
    options = ("--points", "2000", "--size", "32", "--repeats", "2", "--calls", "1", "--threads", "1")
    output = printed("rasterize.py", *options)
    assert "rasterize: largest difference 0" in output
    assert "rasterize_labels: largest difference 0" in output
    assert "JAX / numpy" in output
    assert "--points 2000" in output


def test_simulate_prints_its_rate_and_where_the_time_goes():
    output = printed("simulate.py", "--sensor", "vlp16", "--azimuth-steps", "90", "--scans", "2", "--repeats", "1")
    for words in ("cull", "cast", "returns", "copy", "2 thread(s):", "scans per second", "Shapes in range", "vlp16"):
        assert words in output
    shares = [int(line.split("%")[0].split()[-1]) for line in output.splitlines() if "%" in line]
    assert len(shares) == 4 and 97 <= sum(shares) <= 103


def test_baselines_are_scored_raw_and_rotated(tmp_path):
    sensor = Sensor(elevations_deg=(2.0, -2.0, -8.0, -16.0), azimuth_steps=90)
    write_dataset(tmp_path, names=("00",), scans=60, sensor=sensor)
    output = printed("baselines.py", "--data", str(tmp_path), "--methods", "scan-context", "random")
    assert "60 scans" in output and "revisits" in output
    cells = [[cell.strip() for cell in line.split("│")[1:-1]] for line in output.splitlines() if "│" in line]
    scores = {row[0]: [float(cell) for cell in row[4:8]] for row in cells}
    assert list(scores) == ["scan-context", "random"]
    assert min(scores["scan-context"]) > max(scores["random"])


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
