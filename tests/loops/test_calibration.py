"""Pairs that are certain by odometry alone, and what a model makes of them."""

import dataclasses

import numpy as np
import pytest

from sglpr_jax.loops.calibration import calibrated, certain_pairs
from sglpr_jax.loops.probability import default_model

FRAMES = 50


@pytest.fixture(scope="module")
def short(drive):
    """The first frames of the drive, some 90 m."""
    parts = {name: getattr(drive, name)[:FRAMES] for name in ("ids", "paths", "label_paths", "positions", "times")}
    return dataclasses.replace(drive, **parts)


@pytest.fixture
def odometry(drive) -> np.ndarray:
    return drive.poses.world_from_lidar[:FRAMES]


@pytest.mark.slow
def test_certain_pairs_are_told_apart(short, params, odometry):
    evidence, is_loop = certain_pairs(params, short, odometry, pairs=20)
    assert 10 <= is_loop.sum() <= 20 and 10 <= (~is_loop).sum() <= 20
    assert np.nanmedian(evidence.ambiguity_ratio[is_loop]) < 0.7 < np.nanmedian(evidence.ambiguity_ratio[~is_loop])
    assert np.median(evidence.along_m[is_loop]) < np.median(evidence.along_m[~is_loop])


@pytest.mark.slow
def test_the_model_fits_them(short, params, odometry):
    model = calibrated(params, short, odometry, pairs=20, seed=1)
    evidence, is_loop = certain_pairs(params, short, odometry, pairs=20, seed=2)
    probability = model.probability(evidence)
    assert probability[is_loop].mean() > 0.8 and probability[~is_loop].mean() < 0.2
    assert "others of 08" in model.made_with and default_model().made_with in model.made_with


def test_odometry_of_another_length_is_refused(short, params, odometry):
    with pytest.raises(ValueError, match="expected odometry of 50 poses, one for each scan of 08, found 3"):
        calibrated(params, short, odometry[:3])


@pytest.mark.slow
def test_a_vehicle_that_stands_still_gives_no_pairs(short, params):
    with pytest.raises(ValueError, match="08: expected frames 2 to 10 m apart"):
        calibrated(params, short, np.tile(np.eye(4), (FRAMES, 1, 1)), pairs=5)
