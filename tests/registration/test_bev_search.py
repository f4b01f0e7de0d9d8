"""The exhaustive search is compared with a search by full inverse Fourier transforms in numpy."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scenes import place, relative, seen_from

from sglpr_jax.grid import DENSITY_RESOLUTION_M
from sglpr_jax.registration.bev_config import VerificationConfig
from sglpr_jax.registration.bev_search import (
    SECOND_DEG,
    SECOND_M,
    coarse_correlations,
    coarse_query,
    likely_rotations,
    search,
    search_near,
)
from sglpr_jax.registration.bev_spectra import (
    cell_count,
    lower_half,
    match_spectra,
    merge_cells,
    prepare_image,
    query_spectra,
    rotate,
    spectrum,
)

SMALL = VerificationConfig(reach_m=12.8, max_shift_m=4.0)


def correlations(query: np.ndarray, match: np.ndarray) -> np.ndarray:
    """Correlation by rotation, row shift and column shift, from full inverse Fourier transforms in numpy."""
    angles = np.arange(SMALL.turns, dtype=np.float32) * np.float32(2 * np.pi / SMALL.turns)
    cell_m = DENSITY_RESOLUTION_M * SMALL.coarse
    small = [merge_cells(prepare_image(image, SMALL), SMALL.coarse) for image in (query, match)]
    queries = np.asarray(spectrum(rotate(small[0], jnp.asarray(angles)), cell_m, SMALL))
    there = np.asarray(spectrum(small[1][None], cell_m, SMALL))
    size, reach = queries.shape[1], cell_count(SMALL.max_shift_m, cell_m)
    shifted = np.fft.irfft2(there * np.conj(queries), (size, size))
    return np.roll(shifted, (reach, reach), (-2, -1))[:, : 2 * reach + 1, : 2 * reach + 1]


@pytest.mark.parametrize("seed", range(2))
def test_peaks_are_those_of_whole_transforms(seed):
    query = seen_from(place(seed), (0.7, -0.5, 2.0))
    matches = np.stack([seen_from(place(k), (0.0, 0.0, 0.0)) for k in (seed, seed + 1)])
    found = jax.device_get(
        search(query_spectra(query, config=SMALL), match_spectra(matches, config=SMALL), config=SMALL)
    )
    for k, match in enumerate(matches):
        volume = correlations(query, match)
        turn, down, right = np.unravel_index(volume.argmax(), volume.shape)
        cell_m, step_deg = DENSITY_RESOLUTION_M * SMALL.coarse, 360 / SMALL.turns
        reach = cell_count(SMALL.max_shift_m, cell_m)
        assert found.correlation[k] == pytest.approx(volume.max(), abs=1e-5)
        assert abs(found.x[k] - (right - reach) * cell_m) <= cell_m / 2 + 1e-5
        assert abs(found.y[k] - (reach - down) * cell_m) <= cell_m / 2 + 1e-5
        assert abs((np.degrees(found.yaw[k]) - turn * step_deg + 180) % 360 - 180) <= step_deg / 2 + 1e-3
        apart = np.abs(np.arange(SMALL.turns) - turn)
        near_turn = np.minimum(apart, SMALL.turns - apart) * step_deg <= SECOND_DEG
        near = [np.abs(np.arange(2 * reach + 1) - at) * cell_m <= SECOND_M for at in (down, right)]
        elsewhere = ~(near_turn[:, None, None] & near[0][None, :, None] & near[1][None, None])
        assert found.second[k] == pytest.approx(volume[elsewhere].max(), abs=1e-5)


def test_the_pose_lies_between_the_cells():
    match, errors = (0.0, 0.0, 0.0), []
    for seed, pose in enumerate([(0.3, 0.1, 0.4), (-0.7, 0.5, 2.0), (1.1, -0.3, -1.2), (0.1, 0.9, 3.0)]):
        spectra = query_spectra(seen_from(place(seed), pose), config=SMALL)
        there = match_spectra(seen_from(place(seed), match)[None], config=SMALL)
        found = search(spectra, there, config=SMALL).at(0)
        expected = relative(match, pose)
        errors.append(np.hypot(found.x - expected[0], found.y - expected[1]))
    assert np.mean(errors) < 0.2  # of cells of .8 m, whose middles would be .3 m off


def test_the_lower_half_of_a_spectrum_is_that_of_larger_cells():
    """The image has no high frequencies, so both spectra are equal after the scaling to unit power."""
    size, cell_m = 40, DENSITY_RESOLUTION_M * SMALL.coarse
    down, right = (np.arange(size) - (size - 1) / 2) * cell_m, (np.arange(size // 2) - (size // 2 - 1) / 2) * 2 * cell_m

    def waves(at: np.ndarray) -> jnp.ndarray:
        angle = 2 * np.pi / (size * cell_m) * at
        return jnp.asarray(np.cos(3 * angle[:, None] + 0.4) + np.sin(2 * angle[None] + 5 * angle[:, None]))

    here = VerificationConfig(reach_m=12.8, max_shift_m=0.0)
    wide = VerificationConfig(reach_m=12.8, max_shift_m=0.0, blur_m=2 * here.blur_m, wide_blur_m=2 * here.wide_blur_m)
    expected = spectrum(waves(right)[None], 2 * cell_m, wide)
    np.testing.assert_allclose(lower_half(spectrum(waves(down)[None], cell_m, here), here), expected, atol=1e-4)


def test_a_pose_near_an_expected_one_is_found_beside_the_best_one():
    query, match = seen_from(place(1), (0.7, -0.5, 2.0)), seen_from(place(1), (0.0, 0.0, 0.0))
    spectra, there = query_spectra(query, config=SMALL), match_spectra(match[None], config=SMALL)
    best = search(spectra, there, config=SMALL).at(0)
    unknown = search_near(spectra, there[0], np.full(3, np.nan), config=SMALL)
    right = search_near(spectra, there[0], np.stack([best.x + 1, best.y - 1, best.yaw]), config=SMALL)
    np.testing.assert_allclose(np.stack(unknown), np.stack(best)[:, None].repeat(2, 1), atol=1e-5)
    np.testing.assert_allclose(np.stack(right), np.stack(best)[:, None].repeat(2, 1), atol=1e-5)
    wrong = search_near(spectra, there[0], np.array([-2.0, 2.0, best.yaw + np.pi], np.float32), config=SMALL)
    assert wrong.correlation[0] == pytest.approx(float(best.correlation), abs=1e-5)
    assert wrong.correlation[1] < wrong.correlation[0] and np.hypot(wrong.x[1] + 2, wrong.y[1] - 2) < 3.5


PLACES, TRUE = 12, 7


def test_the_true_place_has_the_highest_coarse_correlation():
    images = np.stack([seen_from(place(seed), (0.0, 0.0, 0.0)).astype(np.uint8) for seed in range(PLACES)])
    query = query_spectra(seen_from(place(TRUE), (1.2, -0.8, 2.5)).astype(np.uint8))
    matches = lower_half(match_spectra(images), VerificationConfig())
    by_rotation = np.asarray(coarse_correlations(coarse_query(query), matches))
    found = by_rotation.max(1)
    assert found.argmax() == TRUE and np.delete(found, TRUE).max() < 0.5 < found[TRUE]
    some = np.asarray(coarse_correlations(coarse_query(query), matches, TRUE))
    np.testing.assert_allclose(some[:TRUE], by_rotation[:TRUE], atol=1e-6)
    assert (some[TRUE:] == -1).all()


@pytest.mark.parametrize("yaw", [0.0, 0.04, 1.6, 3.1, 4.8])
def test_the_likely_rotations_have_the_highest_peak(yaw):
    """Of a true place, the search at few rotations finds the same pose as the search at all, also next to 0 degrees."""
    query = query_spectra(seen_from(place(TRUE), (1.2, -0.8, yaw)).astype(np.uint8))
    there = match_spectra(seen_from(place(TRUE), (0.0, 0.0, 0.0)).astype(np.uint8)[None])
    likely = likely_rotations(
        np.asarray(coarse_correlations(coarse_query(query), lower_half(there, VerificationConfig())))
    )
    assert likely.shape == (1, 12)
    at_all, at_likely = search(query, there), search(query, there, rotations=likely)
    np.testing.assert_allclose(np.stack(at_likely)[:4], np.stack(at_all)[:4], atol=1e-4)
    assert float(at_likely.second[0]) <= float(at_all.second[0]) + 1e-6
