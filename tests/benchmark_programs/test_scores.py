"""What benchmarks score: methods beside each other, ways of training, rotations and mountings."""

import numpy as np
import pytest

from sglpr_jax.retrieval.descriptor_file import DescriptorFile
from sglpr_jax.sim.dataset import simulate

from .programs import SENSOR, printed, table

pytestmark = pytest.mark.slow


def test_baselines_are_scored_raw_and_rotated(tmp_path):
    simulate(tmp_path, routes=("00",), scans=60, sensor=SENSOR)
    output = printed("quality.baselines", "--data", str(tmp_path), "--methods", "scan-context", "random")
    assert "60 scans" in output and "revisits" in output
    scores = {row[0]: [float(cell) for cell in row[4:8]] for row in table(output)}
    assert list(scores) == ["scan-context", "random"]
    assert min(scores["scan-context"]) > max(scores["random"])


def test_two_ways_of_training_are_compared_seed_by_seed(tmp_path):
    rng = np.random.default_rng(0)
    places = np.repeat(rng.normal(size=(1, 120, 16)), 2, axis=0).reshape(240, 16)  # every place twice
    positions = np.tile(np.stack([np.arange(120) * 10.0, np.zeros(120), np.zeros(120)], axis=1), (2, 1))

    def written(name: str, noise: float) -> str:
        descriptors = (places + noise * rng.normal(size=places.shape)).astype(np.float32)
        frames = {"sequence": "06", "ids": tuple(map(str, range(240))), "positions": positions, "pose_source": "true"}
        times = np.arange(240) * 1.0
        DescriptorFile(**frames, times=times, descriptors=descriptors, config={}, weights_hash="").save(tmp_path / name)
        return str(tmp_path / name)

    good, bad = ([written(f"{noise}-{seed}.npz", noise) for seed in (1, 2)] for noise in (0.05, 2.0))
    output = printed("quality.paired", "--ours", *good, "--others", *bad)
    (row,) = [line for line in output.splitlines() if "top1-f1max" in line]
    ours, others, difference, each, interval = (cell.strip() for cell in row.split("│")[2:-1])
    assert float(ours) == 1 and 0 < float(others) < 0.9
    assert float(difference) == pytest.approx(float(ours) - float(others), abs=2e-3)
    assert np.mean([float(one) for one in each.split()]) == pytest.approx(float(difference), abs=2e-3)
    low, high = map(float, interval.split(" to "))
    assert 0 < low < float(difference) < high


def test_the_movement_of_descriptors_under_rotations_is_measured(tmp_path):
    simulate(tmp_path, routes=("08",), scans=40, sensor=SENSOR, images=True)
    options = ("--scans", "2", "--step-deg", "120", "--among", "20")
    output = printed("quality.rotation", "--data", str(tmp_path), "--weights", "circular", *options)
    assert output.splitlines()[-1].startswith("circular: ")
    assert "4 rotations of 2 scans: moved by 0." in output


def test_mounting():
    options = ("--scans", "24", "--routes", "06", "--sensors", "vlp16", "--heights", "1.0", "--pitches", "10")
    row = printed("quality.mounting", *options, "--azimuth-steps", "180").splitlines()[-1]
    cells = [cell.strip() for cell in row.strip("|").split("|")]
    assert cells[:3] == ["vlp16", "1", "10"] and cells[5] == "0 of 24"
    assert float(cells[3]) < 0.1 and float(cells[6]) < 0.1
