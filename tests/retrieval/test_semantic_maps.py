import dataclasses

import jax
import jax.numpy as jnp
import numpy as np

from sglpr_jax.bev import Grid, rasterize, rasterize_labels
from sglpr_jax.data.density_image import density_bev, density_label_bev
from sglpr_jax.models.presets import model_preset
from sglpr_jax.models.sglpr import field_of_view, init, segment
from sglpr_jax.retrieval.semantic_maps import semantic_map


def test_a_map_holds_the_likeliest_known_class_where_points_are():
    params = init(jax.random.key(0), preset="tiny")
    rng = np.random.default_rng(0)
    points = rng.normal(0, 9, (700, 3)).astype(np.float32)
    classes = rng.integers(0, 20, 700).astype(np.int32)
    found = semantic_map(params, points, classes)
    grid = params.config.grid
    counts = np.asarray(rasterize(points, grid=grid))
    seen = (counts > 0) & field_of_view(params.config)[0]
    logits = np.asarray(segment(params, jnp.asarray(counts)))
    np.testing.assert_array_equal(found.counts, counts)
    np.testing.assert_array_equal(found.seen, seen)
    np.testing.assert_array_equal(found.predicted, np.where(seen, logits[..., 1:].argmax(-1) + 1, 0))
    np.testing.assert_array_equal(found.truth, np.where(seen, rasterize_labels(points, classes, grid=grid), 0))
    unlabelled = semantic_map(params, points)
    np.testing.assert_array_equal(unlabelled.predicted, found.predicted)
    assert not unlabelled.truth.any()


def test_the_map_of_a_model_for_density_images_lies_on_such_an_image(random_params):
    config = dataclasses.replace(model_preset("tiny"), grid=Grid(0.4, 32, 32), image="density")
    params = random_params(config)
    rng = np.random.default_rng(0)
    points = rng.normal(0, [5, 5, 1], (700, 3)).astype(np.float32)
    classes = rng.integers(1, 20, 700).astype(np.int32)
    found = semantic_map(params, points, classes)
    counts, truth = (view[59:91, 59:91] for view in (density_bev(points), density_label_bev(points, classes)))
    np.testing.assert_array_equal(found.counts, counts)
    np.testing.assert_array_equal(found.seen, counts > 0)
    np.testing.assert_array_equal(found.truth, np.where(counts > 0, truth, 0))
    likeliest = np.asarray(segment(params, jnp.asarray(counts)))[..., 1:].argmax(-1) + 1
    np.testing.assert_array_equal(found.predicted, np.where(counts > 0, likeliest, 0))
