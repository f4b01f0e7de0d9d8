"""The losses against the PyTorch references, under chunks and masks, and where their gradients could break."""

from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from sglpr_jax import losses

FIXTURE = Path(__file__).parent / "fixtures" / "losses.npz"
TOLERANCE = 1e-4


@pytest.fixture(scope="module")
def golden() -> dict[str, np.ndarray]:
    with np.load(FIXTURE, allow_pickle=False) as file:
        return {name: file[name] for name in file.files}


@pytest.fixture(scope="module")
def images(golden):
    """Logits with the classes last, as ours have them, and labels."""
    return jnp.asarray(np.moveaxis(golden["logits"], 1, -1)), jnp.asarray(golden["labels"], jnp.int32)


def assert_parity(found, expected):
    found, expected = np.asarray(found, np.float64), np.asarray(expected, np.float64)
    assert found.shape == expected.shape
    assert np.abs(found - expected).max() <= TOLERANCE * np.abs(expected).max()


def dice(logits, labels, where=None):
    return losses.dice_from_sums(losses.dice_sums(logits, labels, where))


def mean_cross_entropy(logits, labels):
    return losses.cross_entropy(logits, labels).mean()


@pytest.mark.parametrize(("name", "loss"), [("dice", dice), ("ce", mean_cross_entropy)])
def test_segmentation_losses_are_the_references(golden, images, name, loss):
    value, gradient = jax.jit(jax.value_and_grad(loss))(*images)
    assert_parity(value, golden[name])
    assert_parity(np.moveaxis(gradient, -1, 1), golden[f"{name}_grad"])


@pytest.mark.parametrize("balance", [0.0, 0.5])
def test_a_balanced_cross_entropy_weighs_pixels_by_their_class(images, balance):
    logits, labels = images
    log_probability = np.asarray(jax.nn.log_softmax(logits), np.float64)
    where = np.random.default_rng(0).random(labels.shape) < 0.7
    for i, (own, pixel) in enumerate(zip(np.asarray(labels), where, strict=True)):
        each = -np.take_along_axis(log_probability[i], own[..., None], -1)[..., 0][pixel]
        weight = np.bincount(own[pixel], minlength=logits.shape[-1])[own[pixel]] ** -balance
        found = losses.cross_entropy(logits, labels, where=jnp.asarray(where), balance=balance)[i]
        np.testing.assert_allclose(found, (weight * each).sum() / weight.sum(), rtol=1e-5)


def test_sums_of_chunks_give_the_dice_of_the_batch(images):
    logits, labels = images
    chunks = [losses.dice_sums(logits[i : i + 1], labels[i : i + 1]) for i in range(len(logits))]
    np.testing.assert_allclose(losses.dice_from_sums(sum(chunks)), dice(logits, labels), rtol=1e-6)
    mean_of_images = np.mean([losses.dice_from_sums(sums) for sums in chunks])
    assert abs(mean_of_images - float(dice(logits, labels))) > 1e-3  # which is another loss


def test_pixels_and_images_left_out_count_for_nothing(images):
    logits, labels = images
    where = jax.random.bernoulli(jax.random.key(0), 0.3, labels.shape).at[1].set(False)
    scrambled = jnp.where(where[..., None], logits, 9 * logits[..., ::-1])
    for loss in (losses.cross_entropy, dice):
        np.testing.assert_allclose(loss(logits, labels, where=where), loss(scrambled, labels, where=where), rtol=1e-6)
        np.testing.assert_allclose(loss(logits, labels, where=labels >= 0), loss(logits, labels), rtol=1e-5)
    assert losses.cross_entropy(logits, labels, where=where)[1] == 0
    value, gradient = jax.value_and_grad(lambda logits: dice(logits, labels, where=where))(logits)
    np.testing.assert_allclose(value, dice(logits[::2], labels[::2], where=where[::2]), rtol=1e-6)
    assert np.abs(gradient[1]).max() == 0 and np.isfinite(gradient).all()


@pytest.mark.parametrize("ignore_zero", [False, True])
@pytest.mark.parametrize("reduction", ["sum", "max"])
@pytest.mark.parametrize("closest", [False, True])
def test_triplet_loss_is_the_reference(golden, closest, reduction, ignore_zero):
    anchor, positive, negative = (jnp.asarray(golden[name]) for name in ("q", "pos", "neg"))
    case = f"min{int(closest)}_lazy{int(reduction == 'max')}_ignore{int(ignore_zero)}"

    def loss(anchor):
        distances = [
            losses.descriptor_distance(*jnp.broadcast_arrays(anchor, others), squared=True)
            for others in (positive, negative)
        ]
        each = losses.lazy_triplet(
            *distances, margin=float(golden["margin"]), closest_positive=closest, reduction=reduction
        )
        return each.sum() / (each > 1e-16).sum() if ignore_zero else each.mean()

    value, gradient = jax.jit(jax.value_and_grad(loss))(anchor)
    assert_parity(value, golden[f"triplet_{case}"])
    assert_parity(gradient, golden[f"triplet_gq_{case}"])


def distances(*, tuples: int = 5, negatives: int = 7):
    rng = np.random.default_rng(0)
    return jnp.asarray(rng.uniform(0.2, 1, (tuples, 2)), jnp.float32), jnp.asarray(
        rng.uniform(0, 2, (tuples, negatives)), jnp.float32
    )


@pytest.mark.parametrize("options", [{}, {"reduction": "sum"}, {"temperature": 0.1}], ids=["max", "sum", "smooth"])
def test_a_masked_negative_is_as_if_it_were_not_there_and_a_tuple_without_any_has_no_gradient(options):
    positive, negative = distances()
    where = jnp.ones(negative.shape, bool).at[:, 4:].set(False)
    masked = losses.lazy_triplet(positive, negative, margin=0.3, where=where, **options)
    np.testing.assert_allclose(masked, losses.lazy_triplet(positive, negative[:, :4], margin=0.3, **options), rtol=1e-6)

    def loss(positive, negative):
        return losses.lazy_triplet(positive, negative, margin=0.3, where=where.at[2].set(False), **options)

    assert loss(positive, negative)[2] == 0
    for gradient in jax.grad(lambda *pair: loss(*pair).sum(), (0, 1))(positive, negative):
        assert np.isfinite(gradient).all()
        assert np.abs(gradient[2]).max() == 0


@pytest.mark.parametrize("options", [{}, {"reduction": "sum"}, {"temperature": 0.1}], ids=["max", "sum", "smooth"])
def test_with_one_threshold_every_anchor_has_the_negatives_of_all(options):
    positive, negative = distances()
    where = jnp.asarray(np.random.default_rng(1).random(negative.shape) < 0.7)
    found = jax.jit(lambda *x: losses.one_threshold(*x[:2], where=x[2], margin=0.3, **options))(
        positive, negative, where
    )
    everyone = np.asarray(negative)[np.asarray(where)]
    for i, own in enumerate(positive):
        alone = losses.lazy_triplet(own[None], jnp.asarray(everyone)[None], margin=0.3, **options)
        np.testing.assert_allclose(found[i], alone[0], rtol=1e-5)


def test_the_smooth_triplet_loss_tends_to_the_lazy_one():
    positive, negative = distances()
    lazy = losses.lazy_triplet(positive, negative, margin=0.3)
    gaps = [
        float(jnp.abs(losses.lazy_triplet(positive, negative, margin=0.3, temperature=t) - lazy).max())
        for t in (0.3, 0.03, 0.003)
    ]
    assert gaps[0] > 10 * gaps[2] > 0
    # T log(1 + sum over n of exp(x / T)) lies at most T log(n + 1) above the maximum of 0 and the x.
    assert all(gap <= t * np.log(8) + 1e-6 for gap, t in zip(gaps, (0.3, 0.03, 0.003), strict=True))


@pytest.mark.parametrize("squared", [False, True])
def test_distance_is_numpys_and_its_gradient_is_finite_where_two_descriptors_are_equal(squared):
    a, b = np.random.default_rng(0).normal(size=(2, 3, 8)).astype(np.float32)
    b[1] = a[1]
    expected = np.linalg.norm(a - b, axis=-1) ** (2 if squared else 1)

    def distance(a):
        return losses.descriptor_distance(a, jnp.asarray(b), squared=squared)

    np.testing.assert_allclose(jax.jit(distance)(jnp.asarray(a)), expected, rtol=1e-6)
    gradient = jax.grad(lambda a: distance(a).sum())(jnp.asarray(a))
    np.testing.assert_array_equal(gradient[1], 0)
    assert np.isfinite(gradient).all() and np.abs(gradient[0]).max() > 0


def test_joint_loss_weighs_its_terms():
    terms = {"triplet": jnp.float32(1), "cross_entropy": jnp.float32(10), "dice": jnp.float32(100)}
    total = losses.joint(terms, {"dice": 0.6, "cross_entropy": 0.4, "triplet": 1.0})
    assert float(total) == pytest.approx(65)
