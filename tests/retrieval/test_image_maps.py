"""Maps of classes and of features lie on the grid of the image, for every kind of model."""

import dataclasses
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from PIL import Image
from recordings import of_images

from sglpr_jax.bev import even_cells, rasterize, rasterize_labels
from sglpr_jax.data.formats.png import label_image_pixels
from sglpr_jax.data.recording import Recording
from sglpr_jax.data.scan import Scan
from sglpr_jax.grid import Grid
from sglpr_jax.labels import to_raw
from sglpr_jax.models.backbone_config import SwinConfig
from sglpr_jax.models.config import HeadConfig, model_preset
from sglpr_jax.models.input_image import field_of_view
from sglpr_jax.models.sglpr import forward, init, segment
from sglpr_jax.models.weights import Params
from sglpr_jax.retrieval.image_maps import heat_maps, semantic_map

HEAD = HeadConfig(channels=(16,), kernels=(4,), strides=(4,), cbam_reduction=4, clusters=4)
CONFIG = dataclasses.replace(
    model_preset("tiny"),
    grid=Grid(resolution_m=1.0, height=16, width=16),
    backbone=SwinConfig(embed_dim=8, depths=(1,), heads=(2,), window=4, drop_path=0.1),
    head=HEAD,
)


@pytest.fixture(scope="module")
def params() -> Params:
    return init(jax.random.key(0), preset="tiny")


def probabilities(params: Params, counts: np.ndarray) -> np.ndarray:
    """The reference: the softmax over the known classes, of the image and of its mirror image, one by one."""
    views = []
    for step in (1, -1):
        logits = np.asarray(segment(params, jnp.asarray(counts[:, ::step])), np.float64)[:, ::step, 1:]
        exponentials = np.exp(logits - logits.max(-1, keepdims=True))
        views.append(exponentials / exponentials.sum(-1, keepdims=True))
    return np.mean(views, axis=0)


@pytest.mark.slow
def test_a_map_holds_the_likeliest_known_class_where_points_are(params):
    rng = np.random.default_rng(0)
    points = rng.normal(0, 9, (700, 3)).astype(np.float32)
    classes = rng.integers(0, 20, 700).astype(np.int32)
    found = semantic_map(params, Scan(points=points, labels=to_raw(classes)))
    grid = params.config.grid
    counts = np.asarray(rasterize(points, grid=grid))
    seen = (counts > 0) & field_of_view(params.config)[0]
    likeliest = probabilities(params, counts).argmax(-1) + 1
    np.testing.assert_array_equal(found.counts, counts)
    np.testing.assert_array_equal(found.seen, seen)
    np.testing.assert_array_equal(found.predicted, np.where(seen, likeliest, 0))
    np.testing.assert_array_equal(found.truth, np.where(seen, rasterize_labels(points, classes, grid=grid), 0))
    unlabelled = semantic_map(params, Scan(points=points))
    np.testing.assert_array_equal(unlabelled.predicted, found.predicted)
    assert not unlabelled.truth.any()


def image_sequence(image: np.ndarray, label_path: Path | None) -> Recording:
    return of_images({Path("0.png"): image}, name="06", label_paths=(label_path,))


def test_the_map_of_an_image_is_that_of_its_middle_where_it_is_not_empty(params, tmp_path):
    grid = params.config.grid
    rng = np.random.default_rng(0)
    image = rng.poisson(0.3, (grid.height + 3, grid.width + 6)).astype(np.float32)
    Image.fromarray(label_image_pixels(np.full(image.shape, 50))).save(tmp_path / "0.png")
    found = semantic_map(params, image_sequence(image, tmp_path / "0.png").scan(0))
    middle = np.asarray(even_cells(jnp.asarray(image)))[2 : 2 + grid.height, 3 : 3 + grid.width]
    seen = (middle > 0) & field_of_view(params.config)[0]
    likeliest = probabilities(params, middle).argmax(-1) + 1
    np.testing.assert_array_equal(found.counts, middle)
    np.testing.assert_array_equal(found.predicted, np.where(seen, likeliest, 0))
    np.testing.assert_array_equal(found.truth, np.where(seen, 13, 0))  # building
    assert not semantic_map(params, image_sequence(image, None).scan(0)).truth.any()


def test_cells_the_network_is_not_sure_of_are_left_unlabelled(params):
    points = np.random.default_rng(0).normal(0, 9, (700, 3)).astype(np.float32)
    every = semantic_map(params, Scan(points=points))
    confidence = probabilities(params, every.counts).max(-1)
    least = np.quantile(confidence[every.seen], 0.5) + 1e-6
    found = semantic_map(params, Scan(points=points), min_confidence=least)
    clear = np.abs(confidence - least) > 1e-5
    expected = np.where(confidence >= least, every.predicted, 0)
    np.testing.assert_array_equal(found.predicted[clear], expected[clear])
    assert 0 < found.seen.sum() < every.seen.sum()


@pytest.mark.slow
@pytest.mark.parametrize("polar", [None, (8, 32)])
def test_maps_lie_on_the_grid_of_the_image_and_follow_it(random_params, polar):
    params = random_params(dataclasses.replace(CONFIG, polar=polar, field="circle"))
    image = np.zeros((16, 16), np.int32)
    image[2:6, 7:12] = 5
    found, other = heat_maps(params, image), heat_maps(params, image[::-1].copy())
    assert list(found) == ["encoder, first", "encoder, last", "decoder", "CBAM"]
    for name, values in found.items():
        assert values.shape == (16, 16)
        assert np.isnan(values[0, 0]) and np.isfinite(values[4, 8])
        assert (np.nanmin(values), np.nanmax(values)) == (0, 1)
        assert np.nanmax(np.abs(values - other[name])) > 0.1


@pytest.mark.slow
@pytest.mark.parametrize("preset", ["paper", "sglpr", "sglpr-small"])
def test_the_maps_that_a_preset_names_are_there_and_have_the_form_of_its_image(preset):
    """Traced only, so that the paper's sizes cost nothing."""
    config = model_preset(preset)
    shape = (1, config.grid.height, config.grid.width)
    params = jax.eval_shape(lambda: init(jax.random.key(0), config=config))
    maps = jax.eval_shape(lambda p, x: forward(p, x, segment=0), params, jnp.zeros(shape)).intermediates
    height, width = config.image_size
    for title, name in config.pictures.items():
        _, rows, columns, _ = maps[name].shape
        assert height % rows == 0 and width % columns == 0, title
