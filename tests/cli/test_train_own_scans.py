"""bin/train on scans of the user: flags for format and mounting, and skipped bad scans."""

import json
import shutil

import numpy as np
import pytest

from sglpr_jax.cli.train import SETTINGS, TrainCommand, settings


def test_newer_flags_are_stored_only_if_they_differ_from_their_defaults():
    assert tuple(settings(TrainCommand())) == SETTINGS
    said = settings(TrainCommand(sensor_height=0.6, skip_bad=True, format="float32x4"))
    assert {name: said[name] for name in said if name not in SETTINGS} == {
        "format": "float32x4",
        "sensor_height": 0.6,
        "skip_bad": True,
    }


@pytest.fixture
def damaged(town, tmp_path):
    """The town with an empty scan in 00, and one of zeros in 08, which is tested."""
    root = shutil.copytree(town, tmp_path / "town")
    (root / "sequences/00/velodyne/000003.bin").write_bytes(b"")
    scan = root / "sequences/08/velodyne/000005.bin"
    scan.write_bytes(bytes(scan.stat().st_size))
    return root


@pytest.mark.slow
def test_bad_scans_are_skipped_before_the_training(damaged, preset, command, tmp_path):
    options = ("--seq", "08", "--data", damaged, "--preset", preset, "--method", "polar-fft")
    options += ("--out", tmp_path / "run", "--cache", tmp_path / "cache")
    ended = command("train", *options, "--skip-bad", "--sensor-height", "1.73")
    assert ended.status == 0, ended.error
    assert "skipped 000003: " in ended.error and "skipped 000005: scan 000005 of sequence 08" in ended.error
    assert "as given" in ended.error and len(list((tmp_path / "cache").iterdir())) == 2
    assert json.loads((tmp_path / "run/config.json").read_text())["skip_bad"] is True
    with np.load(tmp_path / "run/test/polar-fft-raw.npz") as file:
        assert len(file["ids"]) == 39 and "000005" not in file["ids"]
