"""What a step sees, and its gradient: a step in chunks is the step of the whole batch, and it learns."""

import dataclasses
import functools

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from sglpr_jax.grid import Grid
from sglpr_jax.labels import UNLABELLED
from sglpr_jax.models.sglpr import forward
from sglpr_jax.models.weights import by_name, for_places
from sglpr_jax.training.batches import in_batch_order, in_network_order, mix
from sglpr_jax.training.config import LossConfig, OcclusionConfig, without_untrained_head
from sglpr_jax.training.image_network import ImageNetwork, _angles, _chunks, gradients, summarize, visible
from sglpr_jax.training.loss import Summary, joint_loss, triplet, violations
from sglpr_jax.training.step import train_step

from .conftest import FAST_COMPILE, SWIN


@functools.partial(jax.jit, static_argnames="config", compiler_options=FAST_COMPILE)
def gradients_of(params, batch, config):
    return gradients(params, chunks_of(batch, config), batch, config.loss)


def chunks_of(batch, config):
    return _chunks(batch, *jax.random.split(jax.random.key(0)), config)


def assert_same(found, expected):
    """Equal to float32 accuracy, measured against the largest value of each array."""
    for a, b in zip(jax.tree.leaves(found), jax.tree.leaves(expected), strict=True):
        np.testing.assert_allclose(a, b, rtol=0, atol=1e-4 * np.abs(b).max() + 1e-7)


@pytest.fixture(scope="module")
def whole(config, params, make_batch):
    """The gradient and the metrics of a labelled batch that goes through the network at once."""
    return gradients_of(params, make_batch(0), config)


def test_chunks_give_the_gradient_and_metrics_of_the_whole_batch(config, params, make_batch, whole):
    gradient, metrics = gradients_of(params, make_batch(0), dataclasses.replace(config, chunk=2))
    assert set(metrics) == {"loss", "triplet", "cross_entropy", "dice", "violations"}
    assert_same(metrics, whole[1])
    assert_same(gradient, whole[0])
    assert np.abs(gradient["segmentation_head"]["kernel"]).max() > 1e-3
    assert np.abs(gradient["place_head"]["netvlad"]["centres"]).max() > 1e-3


@pytest.fixture(scope="module")
def mapped(make_batch, config):
    """A batch of images of which every third has no labels."""
    batch = make_batch(0, images=True)
    maps = np.random.default_rng(1).integers(0, 20, batch.images.shape).astype(np.int32)
    return batch.replace(maps=maps, labelled=np.arange(config.images) % 3 != 0)


@pytest.mark.slow
def test_images_with_label_maps_teach_semantics_in_chunks_too(config, params, make_batch, mapped):
    gradient, metrics = gradients_of(params, mapped, config)
    assert metrics["cross_entropy"] > 0 and metrics["dice"] > 0
    np.testing.assert_allclose(
        metrics["triplet"], gradients_of(params, make_batch(0, images=True), config)[1]["triplet"]
    )
    assert np.abs(gradient["segmentation_head"]["kernel"]).max() > 1e-3
    assert_same(gradients_of(params, mapped, dataclasses.replace(config, chunk=4)), (gradient, metrics))
    scrambled = np.where(mapped.labelled[:, None, None], mapped.maps, (mapped.maps + 3) % 20)
    assert (scrambled != mapped.maps).any()
    chex.assert_trees_all_equal(gradients_of(params, mapped.replace(maps=scrambled), config)[1], metrics)


def test_the_gradient_of_the_segmentation_losses_comes_from_labelled_images_alone(config, params, mapped):
    batch = jax.tree.map(jnp.asarray, mapped)
    chunk = jax.tree.map(lambda x: x[0], chunks_of(batch, config))

    def segmentation_loss(images):
        metrics = joint_loss(summarize(params, chunk._replace(images=images), config.loss), batch, config.loss)[1]
        return metrics["cross_entropy"] + metrics["dice"]

    gradient = jax.jit(jax.grad(segmentation_loss), compiler_options=FAST_COMPILE)(chunk.images)
    np.testing.assert_array_equal(np.abs(gradient).max((1, 2)) > 0, mapped.labelled)


def test_the_metrics_are_those_of_numpy(config, params, make_batch, whole):
    batch = make_batch(0)
    chunks = chunks_of(batch, config)
    outputs = jax.jit(forward)(params, chunks.images[0])
    d, logits = (np.asarray(x, np.float64) for x in (outputs.descriptor, outputs.logits))

    def distance(a, b):
        return np.linalg.norm(d[a] - d[b])

    triplets = [
        max(0, *(config.loss.margin + distance(a, a + 1) - distance(a, n) for n in (a + 2, a + 3))) for a in (0, 4)
    ]
    np.testing.assert_allclose(whole[1]["triplet"], np.mean(triplets), rtol=1e-4)
    np.testing.assert_allclose(whole[1]["violations"], np.mean(np.array(triplets) > 0))

    p = np.exp(logits - logits.max(-1, keepdims=True))
    p = (p / p.sum(-1, keepdims=True))[batch.labelled]
    truth = np.eye(20)[np.asarray(chunks.maps[0])[batch.labelled]]
    np.testing.assert_allclose(whole[1]["cross_entropy"], -np.log((p * truth).sum(-1)).mean(), rtol=1e-4)
    overlap, total = (2 * p * truth).sum((0, 1, 2)), (p**2 + truth**2).sum((0, 1, 2))
    np.testing.assert_allclose(whole[1]["dice"], np.mean(1 - (overlap + 1e-5) / (total + 1e-5)), rtol=1e-4)
    expected = whole[1]["triplet"] + 0.4 * whole[1]["cross_entropy"] + 0.6 * whole[1]["dice"]
    np.testing.assert_allclose(whole[1]["loss"], expected, rtol=1e-6)


def test_what_lies_under_unlabelled_places_does_not_matter(config, params, make_batch, whole):
    batch = make_batch(0)
    scrambled = np.where(batch.labelled[:, None], batch.classes, (batch.classes + 3) % 20)
    assert (scrambled != batch.classes).any()
    chex.assert_trees_all_equal(gradients_of(params, batch.replace(classes=scrambled), config), whole)


def test_a_batch_without_one_labelled_place_has_no_segmentation_loss(config, params, make_batch):
    batch = make_batch(0).replace(labelled=np.zeros(config.images, bool))
    gradient, metrics = gradients_of(params, batch, config)
    assert metrics["cross_entropy"] == metrics["dice"] == 0
    assert np.abs(gradient["segmentation_head"]["kernel"]).max() == 0
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(gradient))


@pytest.mark.slow
def test_segmenting_every_second_image_is_as_if_the_others_had_no_labels(config, params, make_batch):
    batch = make_batch(0)
    every_second = batch.replace(labelled=batch.labelled & (np.arange(config.images) % 2 == 0))
    expected = gradients_of(params, every_second, config)
    sparse = dataclasses.replace(config, chunk=4, loss=dataclasses.replace(config.loss, segment_every=2))
    found = gradients_of(params, batch, sparse)
    assert_same(found[1], expected[1])
    assert_same(found[0], expected[0])


def test_unlabelled_cells_can_be_left_out_of_the_segmentation_losses(config, params, make_batch):
    batch = make_batch(0)
    config = dataclasses.replace(config, loss=dataclasses.replace(config.loss, ignore_unlabelled=True))
    chunks = chunks_of(batch, config)
    logits = jax.jit(forward)(params, chunks.images[0]).logits
    log_p = np.asarray(jax.nn.log_softmax(logits), np.float64)
    maps = np.asarray(chunks.maps[0])
    counted = (maps != 0) & batch.labelled[:, None, None]
    assert 0 < counted.sum() < maps.size
    truth = np.eye(20)[maps]
    per_image = [-(log_p * truth)[i][counted[i]].sum() / counted[i].sum() for i in np.flatnonzero(batch.labelled)]
    p = np.exp(log_p[counted])
    overlap, total = 2 * (p * truth[counted]).sum(0), np.square(p).sum(0) + np.square(truth[counted]).sum(0)
    metrics = gradients_of(params, batch, config)[1]
    np.testing.assert_allclose(metrics["cross_entropy"], np.mean(per_image), rtol=1e-4)
    np.testing.assert_allclose(metrics["dice"], np.mean(1 - (overlap + 1e-5) / (total + 1e-5)), rtol=1e-4)


@pytest.mark.parametrize(("left_out", "weight"), [("cross_entropy", "ce_weight"), ("dice", "dice_weight")])
def test_a_term_without_weight_is_not_computed(config, params, make_batch, whole, left_out, weight):
    loss = dataclasses.replace(config.loss, **{weight: 0.0})
    _, metrics = gradients_of(params, make_batch(0), dataclasses.replace(config, loss=loss))
    (kept,) = {"cross_entropy", "dice"} - {left_out}
    assert set(metrics) == {"loss", "triplet", "violations", kept}
    np.testing.assert_allclose(metrics[kept], whole[1][kept], rtol=1e-5)
    share = {"cross_entropy": 0.4, "dice": 0.6}[kept]
    np.testing.assert_allclose(metrics["loss"], metrics["triplet"] + share * metrics[kept], rtol=1e-6)


@pytest.mark.slow
def test_the_segmentation_may_learn_alone_and_leaves_descriptors_as_they_are(config, random_params, make_batch):
    head = dataclasses.replace(config.model.head, tap="pixels")
    loss = dataclasses.replace(config.loss, segmentation_alone=True)
    config = dataclasses.replace(config, model=dataclasses.replace(config.model, head=head, detail=4), loss=loss)
    params, batch = random_params(config.model), make_batch(0)
    found, metrics = gradients_of(params, batch, config)
    joint = dataclasses.replace(config, loss=dataclasses.replace(loss, segmentation_alone=False))
    expected, of_all = gradients_of(params, batch, joint)
    assert "triplet" not in metrics
    np.testing.assert_allclose(metrics["loss"], 0.4 * of_all["cross_entropy"] + 0.6 * of_all["dice"], rtol=1e-5)
    described = by_name(for_places(params).weights)
    for name, gradient in by_name(found).items():
        assert_same(gradient, np.zeros_like(gradient) if name in described else by_name(expected)[name])
    assert {"segmentation_head/kernel", "narrow/kernel"} <= set(by_name(found)) - set(described)

    network = ImageNetwork(config)
    state = network.new_state(jax.tree.map(jnp.copy, params))
    learnt = by_name(train_step(state, batch, network=network)[0].params.weights)
    moved = {name for name, value in by_name(params.weights).items() if not np.array_equal(value, learnt[name])}
    assert moved == set(learnt) - set(described)


def test_a_segmentation_that_learns_alone_needs_a_loss_of_its_own_and_moves_nothing_else(config):
    with pytest.raises(ValueError, match="leaves no loss: expected ce_weight or dice_weight above 0"):
        LossConfig(segmentation_alone=True, ce_weight=0.0, dice_weight=0.0)
    loss = dataclasses.replace(config.loss, segmentation_alone=True)
    decaying = dataclasses.replace(config.optimizer, weight_decay=0.1)
    with pytest.raises(ValueError, match=r"expected optimizer.weight_decay 0, found 0.1"):
        dataclasses.replace(config, loss=loss, optimizer=decaying)
    with pytest.raises(ValueError, match="expected a model with a segmentation head, found one without"):
        dataclasses.replace(config, loss=loss, model=dataclasses.replace(config.model, categories=0))


def test_where_nothing_reads_labels_there_are_no_categories(config):
    no_terms = dataclasses.replace(config.loss, ce_weight=0.0, dice_weight=0.0)
    assert config.model.categories == 20
    assert without_untrained_head(config) == config
    assert without_untrained_head(dataclasses.replace(config, loss=no_terms)).model.categories == 0
    reads = {what: dataclasses.replace(config.model.head, input=what) for what in ("counts", "labels")}
    for what, categories in (("counts", 0), ("labels", 20)):
        model = dataclasses.replace(config.model, head=reads[what])
        settled = without_untrained_head(dataclasses.replace(config, model=model, loss=no_terms))
        assert settled.model.categories == categories


@pytest.mark.slow
def test_a_head_that_reads_labels_learns_from_the_maps_in_chunks_too(config, random_params, make_batch):
    head = dataclasses.replace(config.model.head, input="counts+labels")
    config = dataclasses.replace(config, model=dataclasses.replace(config.model, head=head))
    params, batch = random_params(config.model), make_batch(0)
    gradient, metrics = gradients_of(params, batch, config)
    assert set(metrics) == {"loss", "triplet", "violations"} and set(gradient) == {"patch_embed", "place_head"}
    assert_same(gradients_of(params, batch, dataclasses.replace(config, chunk=4)), (gradient, metrics))
    relabelled = batch.replace(classes=(batch.classes + 1) % 20)
    assert gradients_of(params, relabelled, config)[1]["triplet"] != metrics["triplet"]
    with pytest.raises(ValueError, match="expected class maps"):
        gradients_of(params, batch.replace(classes=None), config)


@pytest.mark.slow
def test_both_passes_over_a_chunk_drop_the_same_branches(config, random_params, make_batch):
    """With stochastic depth, too, the gradient is that of one function, in which every chunk has its own key."""
    backbone = dataclasses.replace(SWIN.backbone, drop_path=0.5)
    config = dataclasses.replace(config, chunk=4, model=dataclasses.replace(SWIN, backbone=backbone))
    params, batch = random_params(config.model), jax.tree.map(jnp.asarray, make_batch(0))

    def loss_of(weights):
        chunks = chunks_of(batch, config)
        parts = [
            summarize(dataclasses.replace(params, weights=weights), chunk, config.loss)
            for chunk in (jax.tree.map(lambda x, i=i: x[i], chunks) for i in range(config.images // config.chunk))
        ]
        descriptors, sums = zip(*parts, strict=True)
        summed = jax.tree.map(lambda *chunks: sum(chunks), *sums)
        return joint_loss(Summary(jnp.concatenate(descriptors), summed), batch, config.loss)

    found = gradients_of(params, batch, config)
    plain = jax.grad(loss_of, has_aux=True)
    assert_same(found, jax.jit(plain, compiler_options=FAST_COMPILE)(params.weights))


def test_the_share_of_violations_is_that_of_the_margin_for_the_smooth_loss_too(make_batch):
    batch = jax.tree.map(jnp.asarray, make_batch(0))
    apart = jnp.eye(8).at[1].set(jnp.eye(8)[0])  # the first anchor has its positive at its place
    for temperature in (0.0, 0.2):
        config = LossConfig(margin=0.3, temperature=temperature)
        assert violations(apart, batch, config) == 0.5
        assert triplet(apart, batch, config) > 0


@pytest.mark.slow
def test_steps_lower_the_loss_and_compile_once(config, random_params, make_batch):
    backbone = dataclasses.replace(SWIN.backbone, depths=(1,), drop_path=0.0)
    config = dataclasses.replace(config, model=dataclasses.replace(SWIN, backbone=backbone))
    params = random_params(config.model)
    chex.clear_trace_counter()
    traced = chex.assert_max_traces(train_step.__wrapped__, n=1)
    step = jax.jit(traced, static_argnames="network", donate_argnames="state", compiler_options=FAST_COMPILE)
    network = ImageNetwork(config)

    def run(*, steps: int, start: int = 0):
        state = network.new_state(jax.tree.map(jnp.copy, params)).replace(step=jnp.int32(start))
        seen = []
        for i in range(steps):
            state, metrics = step(state, make_batch(0), network=network)
            assert state.step == start + i + 1
            seen.append(jax.device_get(metrics))
        return state.params.weights, seen

    weights, metrics = run(steps=25)
    losses = [m["loss"] for m in metrics]
    assert np.mean(losses[-5:]) < 0.9 * np.mean(losses[:5])
    assert metrics[0]["gradient_norm"] > 0 and metrics[0]["update_norm"] > 0
    squares = sum(np.square(leaf).sum() for leaf in jax.tree.leaves(weights))
    np.testing.assert_allclose(metrics[-1]["weight_norm"], np.sqrt(squares), rtol=1e-5)

    again = run(steps=2)[1]
    chex.assert_trees_all_equal(again, metrics[:2])
    assert run(steps=1, start=1)[1][0]["loss"] != losses[0]  # each step has its own rotations


def test_rotations_follow_the_key_and_can_be_turned_off(config, make_batch):
    batch = make_batch(0)
    angle_key, other_key = jax.random.split(jax.random.key(0))
    turned, again, other = (
        _chunks(batch, key, other_key, config).images for key in (angle_key, angle_key, jax.random.key(5))
    )
    np.testing.assert_array_equal(turned, again)
    assert (turned != other).any(axis=(0, 2, 3)).all()
    still = [
        _chunks(batch, key, other_key, dataclasses.replace(config, rotate=False)).images
        for key in (angle_key, jax.random.key(5))
    ]
    np.testing.assert_array_equal(*still)


def test_of_a_share_of_the_places_the_rotation_is_a_quarter_turn_or_more(config, make_batch):
    config = dataclasses.replace(config, quarter_turns=0.5)
    keys = jax.random.split(jax.random.key(0), 60)
    quarters = np.stack([_angles(key, config) for key in keys]) / (np.pi / 2)
    whole = np.abs(quarters - np.round(quarters)) < 1e-5
    assert 0.4 < whole.mean() < 0.6
    assert np.bincount(np.round(quarters[whole]).astype(int), minlength=4).min() > whole.sum() / 6
    assert np.ptp(np.histogram(quarters[~whole], bins=4, range=(0, 4))[0]) < (~whole).sum() / 6
    batch = make_batch(0, images=True)
    all_quarters = dataclasses.replace(config, quarter_turns=1.0)
    for image, turned in zip(batch.images, chunks_of(batch, all_quarters).images[0], strict=True):
        assert any(np.allclose(np.rot90(image, k), turned, atol=1e-4) for k in range(4))


def test_labels_count_only_where_the_network_sees(config, make_batch):
    config = dataclasses.replace(config, model=dataclasses.replace(config.model, field="circle"))
    maps = np.asarray(chunks_of(make_batch(0), config).maps)
    down, right = np.mgrid[:16, :16] - 7.5
    outside = np.hypot(down, right) >= 8
    assert (maps[..., outside] == 0).all()
    assert (maps[..., ~outside] > 0).any()


GRID = Grid(resolution_m=1.0, height=64, width=48)
IMAGES = 400


def bearings(grid):
    """Of each cell's centre, degrees, by complex numbers."""
    x, y = np.mgrid[: grid.height, : grid.width] + 0.5
    return np.rad2deg(np.angle((x - grid.height / 2) + 1j * (y - grid.width / 2))) % 360


def widths(hidden, grid):
    """The width of each image's hidden cells in degrees; they must be one sector, without a cell left inside."""
    bearing, group = np.unique(bearings(grid).round(3).ravel(), return_inverse=True)
    step = np.diff([*bearing, bearing[0] + 360])
    found = []
    for one in hidden:
        is_hidden = np.bincount(group, weights=one.ravel()) > 0
        assert (is_hidden != np.roll(is_hidden, 1)).sum() <= 2
        found.append(step[is_hidden].sum())
    return np.array(found)


@pytest.mark.parametrize("widest_deg", [60.0, 180.0, 270.0])
def test_a_sector_of_each_chosen_image_is_hidden(widest_deg):
    config = OcclusionConfig(share=0.5, widest_deg=widest_deg)
    shown = np.asarray(visible(jax.random.key(3), IMAGES, GRID, config))
    hidden_deg = widths(~shown, GRID)
    assert shown.shape == (IMAGES, 64, 48)
    chosen = hidden_deg > 1
    assert 0.4 < chosen.mean() < 0.6
    assert 0.9 * widest_deg < hidden_deg.max() < widest_deg + 2
    np.testing.assert_allclose(np.quantile(hidden_deg[chosen], [0.25, 0.75]) / widest_deg, [0.25, 0.75], atol=0.1)
    hidden_everywhere = (~shown[chosen]).mean(0)  # each bearing as often as the others
    assert np.ptp([hidden_everywhere[bearings(GRID) // 90 == quarter].mean() for quarter in range(4)]) < 0.12


def test_what_is_hidden_has_neither_counts_nor_labels(config, make_batch):
    batch = make_batch(0, images=True)
    batch = batch.replace(
        images=batch.images + 1, maps=np.ones(batch.images.shape, np.int32), labelled=np.ones(config.images, bool)
    )
    batch, config = jax.tree.map(jnp.asarray, batch), dataclasses.replace(config, rotate=False)
    angle_key, model_key = jax.random.split(jax.random.key(0))

    def chunk(occlusion):
        chunks = _chunks(batch, angle_key, model_key, dataclasses.replace(config, occlusion=occlusion))
        return np.asarray(chunks.images[0]), np.asarray(chunks.maps[0])

    whole, labels = chunk(OcclusionConfig())
    images, maps = chunk(OcclusionConfig(share=0.75))
    hidden = images == 0
    assert (whole > 0).all() and hidden.any((1, 2)).sum() >= 3 and not hidden.all((1, 2)).any()
    np.testing.assert_array_equal(images, np.where(hidden, 0, whole))
    np.testing.assert_array_equal(maps, np.where(hidden, UNLABELLED, labels))
    assert (labels != UNLABELLED).any()


def half(batch, rows: slice, tuples: slice):
    """Some tuples of a batch, alone."""
    cut = {
        name: None if value is None else value[rows]
        for name, value in ((n, getattr(batch, n)) for n in ("labelled", "images", "points", "count", "classes"))
    }
    return batch.replace(negatives=batch.negatives[tuples, rows], **cut)


@pytest.fixture
def mixed(make_batch):
    """A tuple of images and one of scans, of which one has no labels; the scans count for the segmentation alone."""
    images = half(make_batch(0, images=True), slice(0, 4), slice(0, 1))
    scans = half(make_batch(1), slice(4, 8), slice(1, 2))
    return mix(images, scans, triplets=False, share_negatives=False)


@pytest.mark.parametrize("every", [1, 2, 4])
def test_labelled_places_come_where_the_segmentation_head_looks_and_go_back(mixed, every):
    places = jnp.arange(8)
    order = in_network_order(places, mixed, every=every)
    np.testing.assert_array_equal(in_batch_order(order, mixed, every=every), places)
    seen = np.asarray(order)[::every]
    assert (seen >= 4).sum() == min(len(seen), 4)
    alone = mixed.replace(also=None)
    np.testing.assert_array_equal(in_network_order(places, alone, every=every), places)


@pytest.mark.slow
def test_the_segmentation_learns_from_labelled_places_alone_and_the_triplet_loss_from_its_own(mixed, config, params):
    assert mixed.labelled.sum() == 3
    gradient, metrics = gradients_of(params, mixed, config)
    assert np.abs(gradient["segmentation_head"]["kernel"]).max() > 1e-3
    assert metrics["cross_entropy"] > 0 and metrics["triplet"] > 0

    def segmentation_gradient(batch):
        return gradients_of(params, batch, config)[0]["segmentation_head"]["kernel"]

    other_images = mixed.replace(images=mixed.images[::-1].copy())
    np.testing.assert_array_equal(segmentation_gradient(other_images), gradient["segmentation_head"]["kernel"])
    unlabelled = np.flatnonzero(~mixed.labelled[4:])
    points = mixed.also.points.copy()
    points[unlabelled] += 3
    other_scan = mixed.replace(also=mixed.also.replace(points=points))
    np.testing.assert_array_equal(segmentation_gradient(other_scan), gradient["segmentation_head"]["kernel"])
    classes = (mixed.also.classes + 1) % 20
    relabelled = mixed.replace(also=mixed.also.replace(classes=classes))
    assert np.abs(segmentation_gradient(relabelled) - gradient["segmentation_head"]["kernel"]).max() > 1e-4
    assert gradients_of(params, relabelled, config)[1]["triplet"] == metrics["triplet"]


@pytest.mark.slow
def test_the_order_changes_nothing_but_who_is_segmented(mixed, config, params):
    every = dataclasses.replace(config, loss=dataclasses.replace(config.loss, segment_every=2))
    expected, found = gradients_of(params, mixed, config), gradients_of(params, mixed, every)
    assert_same(found, expected)  # four of the eight images are segmented: those that could have labels
    assert_same(gradients_of(params, mixed, dataclasses.replace(every, chunk=4)), expected)
