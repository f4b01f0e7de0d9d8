"""A scaled recording has larger scans, and everything else as it was."""

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from recordings import of_images, of_scans

from sglpr_jax.data.mounting import MODEL_HEIGHT_M, Mounting
from sglpr_jax.data.scaled import chosen_scale, scale_of, scaled, scaled_scan
from sglpr_jax.data.scan import Scan

POINTS = np.random.default_rng(0).uniform(-5, 5, (50, 3)).astype(np.float32)
MOUNTINGS = (None, Mounting(0.5), Mounting(0.9, (0.6, 0.0, 0.8), 0.02, 0.3))


def recording(**fields):
    return of_scans({Path(f"{i}.bin"): POINTS + np.float32(i) for i in range(3)}, **fields)


@settings(max_examples=20, deadline=None)
@given(st.sampled_from(MOUNTINGS), st.sampled_from([2, 4]))
def test_points_and_the_ground_below_them_are_scaled(mounting, scale):
    scan, ground = Scan(points=POINTS, mounting=mounting), np.array([0, 0, MODEL_HEIGHT_M])
    before, after = (one.upright_points + ground for one in (scan, scaled_scan(scan, scale)))
    np.testing.assert_allclose(after, scale * before, atol=1e-4)


def test_a_scaled_recording_keeps_positions_and_times():
    positions, times = np.arange(9.0).reshape(3, 3), np.arange(3.0)
    one = recording(positions=positions, times=times, mountings=(MOUNTINGS[2],) * 3)
    found = scaled(one, 4)
    np.testing.assert_array_equal(found.points(2), 4 * one.points(2))
    assert found.mounting_of(1) == Mounting(3.6, (0.6, 0.0, 0.8), 0.08, 0.3)
    assert found.positions is positions and found.times is times and scale_of(found) == 4


@pytest.mark.parametrize(("metres", "expected"), [(5.0, 4), (20.0, 1)])
def test_the_scale_is_chosen_by_how_far_most_points_are(metres, expected):
    """Single far points, rays without an echo, empty scans, and heights do not count."""
    near = np.random.default_rng(1).uniform(-metres, metres, (200, 3)).astype(np.float32)
    near[:10], near[:, 2], near[10] = 80.0, 30.0, np.nan
    near = np.concatenate([near, np.zeros((2000, 3), np.float32)])
    clouds = {Path(f"{i}.bin"): near for i in range(5)} | {Path("5.bin"): near[:0]}
    assert chosen_scale(of_scans(clouds)) == expected
    assert chosen_scale(of_images({Path("0.png"): np.zeros((4, 4), np.float32)})) == 1
