"""The realism benchmark: its measures on clouds worked out by hand, and the whole command on two tiny datasets."""

import importlib
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

ROOT = Path(__file__).resolve().parents[2]
ROAD, CAR = 9, 1


@pytest.fixture
def statistics(monkeypatch):
    monkeypatch.syspath_prepend(str(ROOT))
    return importlib.import_module("benchmarks.quality.scan_statistics")


def test_measures_of_a_scan(statistics):
    points = np.array([(10.1, 0.1, -1.7), (10.2, 0.1, -1.7), (10.1, -3.1, -1.0), (-20.1, 0.1, 0.2)], np.float32)
    measures = statistics.scan_measures(points, np.array([ROAD, ROAD, CAR, 0], np.int32))
    assert measures["points"] == 4
    assert measures["occupied"] == pytest.approx(100 * 3 / 128**2)
    assert bins_above_0(statistics, measures, "range") == {"10 to 15": 0.75, "20 to 30": 0.25}
    assert bins_above_0(statistics, measures, "height") == {"-1.8 to -1.6": 0.5, "-1.2 to -0.8": 0.25, "0 to 0.5": 0.25}
    assert bins_above_0(statistics, measures, "count") == pytest.approx({"1 to 2": 2 / 3, "2 to 3": 1 / 3})
    assert bins_above_0(statistics, measures, "class_of_points") == pytest.approx({"road": 2 / 3, "car": 1 / 3})
    assert bins_above_0(statistics, measures, "class_of_cells") == {"road": 0.5, "car": 0.5}
    assert bins_above_0(statistics, measures, "class_of_pixels") == {"car": 1.0}
    assert measures["image_occupied"] == pytest.approx(100 * 2 / 151**2)
    assert bins_above_0(statistics, measures, "image_distance") == {"10 to 12.5": 0.5, "20 to 25": 0.5}
    assert bins_above_0(statistics, measures, "image_lateral") == {"0 to 1.8": 0.5, "1.8 to 3.8": 0.5}


def bins_above_0(statistics, measures, name: str) -> dict[str, float]:
    _, bins = statistics.HISTOGRAMS[name]
    return {bin_: float(share) for bin_, share in zip(bins, measures[name], strict=True) if share}


def test_scans_without_labels_or_points_have_measures(statistics):
    measures = statistics.scan_measures(np.zeros((0, 3), np.float32), None)
    assert (measures["points"], measures["occupied"], measures["image_occupied"], measures["image_value"]) == (0,) * 4
    assert "class_of_points" not in measures


def test_total_variation_is_the_share_that_must_move(statistics):
    assert statistics.total_variation(np.array([0.5, 0.5, 0]), np.array([0.5, 0.25, 0.25])) == pytest.approx(25)


@pytest.mark.slow
def test_the_command_writes_tables_and_pictures(kitti_root, bev_root, tmp_path):
    for path in (bev_root / "06/imgs").glob("*.png"):
        Image.fromarray(np.eye(151, dtype=np.uint8)).save(path)
    out = tmp_path / "out"
    roots = ("--real", kitti_root, "--simulated", bev_root)
    command = (sys.executable, "-m", "benchmarks.quality.realism", *roots, "--out", out, "--scans", "2")
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    done = subprocess.run(command, capture_output=True, text=True, timeout=120, env=environment)
    assert done.returncode == 0, done.stderr
    assert "Warning" not in done.stderr
    assert "| real scans 08 | simulated images 06 |" in done.stdout
    assert "| scans | 2 | 2 |" in done.stdout
    assert {path.name for path in out.iterdir()} == {"table.md", "histograms.png", "images.png"}
