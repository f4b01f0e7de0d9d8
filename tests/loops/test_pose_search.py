"""The exhaustive search against one by whole Fourier transforms in numpy."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from sglpr_jax.loops.config import VerificationConfig
from sglpr_jax.loops.pose_search import cells, merged, prepared, rotations, search, spectrum

from .scenes import place, relative, seen_from

SMALL = VerificationConfig(reach_m=12.8, max_shift_m=4.0)


def correlations(query: np.ndarray, match: np.ndarray) -> np.ndarray:
    """Of all rotations and shifts (rotation, down, right), by inverse transforms of the whole spectra."""
    angles = np.arange(SMALL.turns, dtype=np.float32) * np.float32(2 * np.pi / SMALL.turns)
    cell_m = SMALL.resolution_m * SMALL.coarse
    small = [merged(prepared(image, SMALL), SMALL.coarse) for image in (query, match)]
    queries = np.asarray(spectrum(rotations(small[0], jnp.asarray(angles)), cell_m, SMALL))
    there = np.asarray(spectrum(small[1][None], cell_m, SMALL))
    size, reach = queries.shape[1], cells(SMALL.max_shift_m, cell_m)
    shifted = np.fft.irfft2(there * np.conj(queries), (size, size))
    return np.roll(shifted, (reach, reach), (-2, -1))[:, : 2 * reach + 1, : 2 * reach + 1]


@pytest.mark.parametrize("seed", range(2))
def test_peaks_are_those_of_whole_transforms(seed):
    query = seen_from(place(seed), (0.7, -0.5, 2.0))
    matches = np.stack([seen_from(place(k), (0.0, 0.0, 0.0)) for k in (seed, seed + 1)])
    found = jax.device_get(search(query, matches, config=SMALL))
    for k, match in enumerate(matches):
        volume = correlations(query, match)
        turn, down, right = np.unravel_index(volume.argmax(), volume.shape)
        cell_m, step_deg = SMALL.resolution_m * SMALL.coarse, 360 / SMALL.turns
        reach = cells(SMALL.max_shift_m, cell_m)
        assert found.correlation[k] == pytest.approx(volume.max(), abs=1e-5)
        assert abs(found.x[k] - (right - reach) * cell_m) <= cell_m / 2 + 1e-5
        assert abs(found.y[k] - (reach - down) * cell_m) <= cell_m / 2 + 1e-5
        assert abs((np.degrees(found.yaw[k]) - turn * step_deg + 180) % 360 - 180) <= step_deg / 2 + 1e-3
        apart = np.abs(np.arange(SMALL.turns) - turn)
        near_turn = np.minimum(apart, SMALL.turns - apart) * step_deg <= SMALL.second_deg
        near = [np.abs(np.arange(2 * reach + 1) - at) * cell_m <= SMALL.second_m for at in (down, right)]
        elsewhere = ~(near_turn[:, None, None] & near[0][None, :, None] & near[1][None, None])
        assert found.second[k] == pytest.approx(volume[elsewhere].max(), abs=1e-5)


def test_the_pose_lies_between_the_cells():
    match, errors = (0.0, 0.0, 0.0), []
    for seed, pose in enumerate([(0.3, 0.1, 0.4), (-0.7, 0.5, 2.0), (1.1, -0.3, -1.2), (0.1, 0.9, 3.0)]):
        found = search(seen_from(place(seed), pose), seen_from(place(seed), match)[None], config=SMALL).one(0)
        expected = relative(match, pose)
        errors.append(np.hypot(found.x - expected[0], found.y - expected[1]))
    assert np.mean(errors) < 0.2  # of cells of .8 m, whose middles would be .3 m off
