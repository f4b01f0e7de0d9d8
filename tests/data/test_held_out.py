"""What is held out of a recording is never seen from what is trained on."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sglpr_jax.data.sampling.config import TupleConfig, ValidationConfig
from sglpr_jax.data.sampling.held_out import hold_out

SAMPLING = TupleConfig(revisit_gap=20)


def wandering(seed: int, frames: int = 400) -> np.ndarray:
    """A recording of 2 m between frames that turns at random, so that it may cross itself; heights are noise."""
    rng = np.random.default_rng(seed)
    heading = np.cumsum(rng.normal(scale=0.15, size=frames))
    across = np.cumsum(2 * np.stack([np.cos(heading), np.sin(heading)], axis=1), axis=0)
    return np.column_stack([across, rng.normal(scale=50, size=frames)])


def apart(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return np.linalg.norm(a[:, None, :2] - b[None, :, :2], axis=-1)


@settings(deadline=None, max_examples=40)
@given(seed=st.integers(0, 10**6), share=st.floats(0.02, 0.5))
def test_no_training_frame_lies_within_the_negative_distance_of_a_validation_frame(seed, share):
    positions = wandering(seed)
    split = hold_out(positions, ValidationConfig(share=share), SAMPLING)
    assert not set(split.training) & set(split.validation)
    assert len(split.validation) >= round(share * len(positions))
    if len(split.training):
        assert apart(positions[split.training], positions[split.validation]).min() > SAMPLING.negative_m
    left_out = np.setdiff1d(np.arange(len(positions)), np.r_[split.training, split.validation])
    if len(left_out):
        assert apart(positions[left_out], positions[split.validation]).min(1).max() <= SAMPLING.negative_m


def test_the_stretch_comes_with_its_revisits_and_its_fair_share_of_them():
    out_and_back = np.r_[np.arange(0, 600, 2.0), np.arange(600, 300, -2.0)]  # the second half of the way out comes back
    positions = np.column_stack([out_and_back, np.zeros((len(out_and_back), 2))])
    split = hold_out(positions, ValidationConfig(share=0.1), SAMPLING)
    there, back = split.validation[split.validation < 300], split.validation[split.validation >= 300]
    assert len(there) and len(back)
    assert apart(positions[there], positions[back]).min(0).max() < SAMPLING.positive_m
    rows = split.training[split.training < 300]
    assert (positions[rows, 0] > 300).sum() > 60  # most of what is revisited is still trained on


def test_a_drive_without_revisits_gives_its_first_frames_and_share_0_nothing():
    positions = np.column_stack([np.arange(0, 400, 2.0), np.zeros((200, 2))])
    split = hold_out(positions, ValidationConfig(share=0.25), SAMPLING)
    np.testing.assert_array_equal(split.validation, np.arange(51))  # and the one frame less than 3 m further on
    np.testing.assert_array_equal(split.training, np.arange(61, 200))
    nothing = hold_out(positions, ValidationConfig(), SAMPLING)
    assert len(nothing.validation) == 0 and len(nothing.training) == 200


@pytest.mark.parametrize("share", [-0.1, 0.6])
def test_a_share_out_of_range_is_refused(share):
    with pytest.raises(ValueError, match=r"ValidationConfig\.share: expected a number from 0 up to 0\.5, found"):
        ValidationConfig(share=share)
