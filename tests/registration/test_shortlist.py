"""The coarse comparison finds a place where descriptors do not."""

import dataclasses

import numpy as np
import pytest
from scenes import place, seen_from

import sglpr_jax
from sglpr_jax.loops.candidates import CandidateFinder
from sglpr_jax.loops.config import CandidateConfig, DetectorConfig
from sglpr_jax.loops.keyframes import Seen
from sglpr_jax.registration.bev_search import coarse_correlations, search
from sglpr_jax.registration.bev_spectra import match_spectra, query_spectra
from sglpr_jax.registration.config import VerificationConfig
from sglpr_jax.se3 import transform

PLACES, TRUE = 12, 7


@pytest.fixture(scope="module")
def images():
    """Images of different places, with the sensor at the centre."""
    return [seen_from(place(seed), (0.0, 0.0, 0.0)).astype(np.uint8) for seed in range(PLACES)]


@pytest.fixture(scope="module")
def query():
    """One of the places, from another position and rotated."""
    return seen_from(place(TRUE), (1.2, -0.8, 2.5)).astype(np.uint8)


def test_the_true_place_has_the_highest_correlation(images, query):
    spectra, matches = query_spectra(query), match_spectra(np.stack(images))
    found = np.asarray(coarse_correlations(spectra, matches))
    assert found.argmax() == TRUE and np.delete(found, TRUE).max() < 0.5 < found[TRUE]
    some = np.asarray(coarse_correlations(spectra, matches, TRUE))
    np.testing.assert_allclose(some[:TRUE], found[:TRUE], atol=1e-6)
    assert (some[TRUE:] == -1).all()


def test_the_correlation_is_that_of_larger_cells_and_wider_blurs(images, query):
    """Up to the aliasing of cells that are averaged, and the highest frequencies."""
    fine = VerificationConfig()
    wide = dataclasses.replace(
        fine, coarse=2 * fine.coarse, turns=fine.turns // 2, blur_m=2 * fine.blur_m, wide_blur_m=2 * fine.wide_blur_m
    )
    found = coarse_correlations(query_spectra(query), match_spectra(np.stack(images)))
    expected = search(query, np.stack(images), config=wide).correlation
    assert np.corrcoef(found, expected)[0, 1] > 0.9 and np.abs(found - expected).max() < 0.15


@pytest.mark.parametrize(("further", "found"), [(1, False), (PLACES, True)])
def test_places_with_distant_descriptors_are_found_by_further_comparisons(images, query, further, found):
    config = CandidateConfig(candidates=1, further=further, recent_m=1e-9, cohort=0, near_cohort=0)
    finder = CandidateFinder(sglpr_jax.load("circular"), DetectorConfig(candidates=config, keyframe_m=0.0))
    descriptors = np.eye(PLACES + 1, finder.index.width, dtype=np.float32)
    for image, descriptor in zip(images, descriptors, strict=False):
        finder.add_seen(Seen(descriptor, image, None))
    wrong = (descriptors[0] + 0.1 * descriptors[-1]).astype(np.float32)
    candidates = finder.add_seen(Seen(wrong / np.linalg.norm(wrong), query, None))
    assert [one.match for one in candidates] == ([TRUE] if found else [])


@pytest.mark.slow
def test_a_good_fit_on_another_floor_does_not_end_the_search(images, query):
    config = CandidateConfig(candidates=1, further=PLACES, recent_m=1e-9, cohort=0, near_cohort=0)
    finder = CandidateFinder(sglpr_jax.load("circular"), DetectorConfig(candidates=config, keyframe_m=0.0))
    descriptors = np.eye(PLACES, finder.index.width, dtype=np.float32)
    upstairs = [images[TRUE], *images[1:]]  # the first place has the same walls as the true one, 8 m higher
    for frame, (image, descriptor) in enumerate(zip(upstairs, descriptors, strict=True)):
        pose = np.eye(4)
        pose[:3, 3] = frame % 3, 0.0, 0.0 if frame else 8.0
        finder.add_seen(Seen(descriptor, image, None), odometry=pose)
    pose = transform(TRUE % 3 + 1.2, -0.8, 2.5)
    best, *others = finder.add_seen(Seen(descriptors[0], query, None), odometry=pose)
    assert best.match == TRUE and [one.match for one in others] in ([], [0])
