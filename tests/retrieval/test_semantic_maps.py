import jax
import jax.numpy as jnp
import numpy as np

from sglpr_jax.bev import rasterize, rasterize_labels
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
