"""Two sources in one batch: the places of both, one after the other, and who is whose negative."""

import jax.numpy as jnp
import numpy as np
import pytest

from sglpr_jax.data.sampling.batch import Batch, views
from sglpr_jax.data.sampling.mixing import mix
from sglpr_jax.grid import Grid

GRID = Grid(resolution_m=1.0, height=16, width=16)
RNG = np.random.default_rng(0)
OWN = np.array([[False, False, True, False, False, False], [False, False, False, False, False, True]])
IMAGES = Batch(np.zeros(6, bool), OWN, 1, images=RNG.uniform(0, 9, (6, 20, 20)).astype(np.float32))
SCANS = Batch(
    np.ones(3, bool),
    np.array([[False, False, True]]),
    1,
    points=RNG.uniform(-8, 8, (3, 30, 3)).astype(np.float32),
    count=np.array([30, 20, 10], np.int32),
    classes=RNG.integers(1, 20, (3, 30)).astype(np.int32),
)


@pytest.mark.parametrize(("first", "second"), [(IMAGES, SCANS), (SCANS, IMAGES), (SCANS, SCANS), (IMAGES, IMAGES)])
def test_the_views_are_those_of_each_source_one_after_the_other(first, second):
    mixed = mix(first, second, triplets=False, share_negatives=True)
    angles = jnp.asarray(RNG.uniform(0, 6, first.places + second.places).astype(np.float32))
    images, maps = views(mixed, angles, GRID)
    parts = views(first, angles[: first.places], GRID), views(second, angles[first.places :], GRID)
    np.testing.assert_array_equal(images, np.concatenate([image for image, _ in parts]))
    if first is second is IMAGES:
        assert maps is None
        return
    expected = [np.zeros(image.shape) if part is None else part for image, part in parts]
    np.testing.assert_array_equal(maps, np.concatenate(expected))
    assert np.asarray(maps).max() > 0
    np.testing.assert_array_equal(mixed.labelled, np.r_[first.labelled, second.labelled])


def test_places_for_the_segmentation_alone_are_nobodys_negatives():
    np.testing.assert_array_equal(mix(IMAGES, SCANS, triplets=False, share_negatives=True).negatives, IMAGES.negatives)


@pytest.mark.parametrize("share_negatives", [False, True])
def test_the_tuples_of_both_sources_lend_each_other_negatives_where_tuples_do(share_negatives):
    negatives = mix(IMAGES, SCANS, triplets=True, share_negatives=share_negatives).negatives
    assert negatives.shape == (3, 9)
    np.testing.assert_array_equal(negatives[:2, :6], IMAGES.negatives)
    np.testing.assert_array_equal(negatives[2:, 6:], SCANS.negatives)
    assert (negatives[:2, 6:] == share_negatives).all() and (negatives[2:, :6] == share_negatives).all()
