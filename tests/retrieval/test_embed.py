"""Every scan gets the descriptor of its own image, whatever the batches; a bad scan never passes in silence."""

import dataclasses
import functools
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest
from recordings import of_images, of_scans, with_points

from sglpr_jax.bev import rasterize, rasterize_labels, rotate_image, rotate_points
from sglpr_jax.data.recording import Recording
from sglpr_jax.grid import Grid
from sglpr_jax.labels import to_classes
from sglpr_jax.methods.handcrafted import HANDCRAFTED
from sglpr_jax.methods.method import HandcraftedMethod, Method
from sglpr_jax.methods.registry import checked_view, handcrafted, method_beside, rotated_scan
from sglpr_jax.models.config import model_preset
from sglpr_jax.models.weights import Params
from sglpr_jax.retrieval.descriptor_file import DescriptorFile
from sglpr_jax.retrieval.embed import embed

GRID = Grid(resolution_m=1.0, height=16, width=16)
SCANS = 7  # 8 is the next power of two
PICTURES = tuple(Path(f"{i:06d}.png") for i in range(SCANS))


def flatten(images):
    """A method whose descriptor is the image itself."""
    return images.reshape(len(images), -1)


def embed_images(describe, recording, grid, *, config, rotation_seed=None, batch=8, on_bad_scan=None, **options):
    """The descriptor file of a method on images."""
    kinds = {name: options.pop(name) for name in ("categories", "image") if name in options}
    method = Method(
        {"method": "pixels", **config},
        "labelled images" if "categories" in kinds else "images",
        functools.partial(checked_view, grid=grid, **kinds),
        lambda views: describe(*(part for part in views if part is not None)),
        weights_hash=options.pop("weights_hash", ""),
    )
    options |= {"rotation_seed": rotation_seed, "batch": batch, "on_bad_scan": on_bad_scan}
    return embed(method, recording, **options)


def embed_scans(describe, recording, *, distance, labels=False, **options):
    """The descriptor file of a handcrafted method on points."""
    made = HandcraftedMethod("mean", "this test", "labelled points" if labels else "points", describe)
    with pytest.MonkeyPatch.context() as patched:
        patched.setitem(HANDCRAFTED, "mean", made)
        method = dataclasses.replace(handcrafted("mean", GRID), distance=distance)
    return embed(method, recording, **options)


def clouds() -> list[np.ndarray]:
    rng = np.random.default_rng(0)
    return [rng.uniform(-9, 9, (n, 3)).astype(np.float32) for n in range(20, 20 + SCANS)]


@pytest.fixture
def scans() -> Recording:
    by_path = {Path(f"{2 * i:06d}.bin"): cloud for i, cloud in enumerate(clouds())}
    positions, times = np.arange(3.0 * SCANS).reshape(SCANS, 3), np.arange(SCANS) / 10
    return of_scans(by_path, positions=positions, times=times, pose_source="poses/08.txt")


@pytest.fixture
def pictures() -> Recording:
    values = np.random.default_rng(0).uniform(0, 10, (SCANS, 20, 24)).astype(np.float32)
    by_path = dict(zip(PICTURES, values, strict=True))
    return of_images(by_path, name="06", positions=np.zeros((SCANS, 3)), pose_source="06/pose.txt")


def mean_point(points, classes=None):
    """A method on points whose descriptor is their mean and, where there are classes, the mean class."""
    return np.append(points.mean(axis=0), [] if classes is None else classes.mean()).astype(np.float32)


def with_bad_scan(recording: Recording, *bad: int) -> Recording:
    def points_of(path: Path) -> np.ndarray:
        row = recording.paths.index(path)
        if row in bad:
            raise ValueError(f"{path}: not a whole scan")
        return recording.points(row)

    return with_points(recording, points_of)


def with_labels(recording: Recording, raw: list[np.ndarray], folder: Path) -> Recording:
    paths = tuple(folder / f"{i}.label" for i in range(SCANS))
    for path, ids in zip(paths, raw, strict=True):
        ids.tofile(path)
    return dataclasses.replace(recording, label_paths=paths)


def drawn_angles(seed: int):
    return np.random.default_rng(seed).uniform(0, 2 * np.pi, SCANS).astype(np.float32)


def test_scans_are_rasterised_and_keep_what_evaluation_needs(scans, tmp_path):
    found = embed_images(flatten, scans, GRID, config={"method": "pixels"}, weights_hash="abc")
    expected = [np.asarray(rasterize(jnp.asarray(cloud), grid=GRID)).reshape(-1) for cloud in clouds()]
    np.testing.assert_array_equal(found.descriptors, expected)
    assert found.descriptors.dtype == np.float32 and found.descriptors.sum() > 0
    assert (found.sequence, found.ids, found.pose_source) == ("08", scans.ids, "poses/08.txt")
    assert (found.config, found.weights_hash) == ({"data": "08", "method": "pixels", "rotation_seed": None}, "abc")
    np.testing.assert_array_equal(found.positions, scans.positions)
    np.testing.assert_array_equal(found.times, scans.times)
    found.save(tmp_path / "08.npz")
    np.testing.assert_array_equal(DescriptorFile.load(tmp_path / "08.npz").descriptors, expected)


def test_each_scan_is_turned_by_its_own_angle(scans):
    found = embed_images(flatten, scans, GRID, config={}, rotation_seed=3)
    for cloud, angle, descriptor in zip(clouds(), drawn_angles(3), found.descriptors, strict=True):
        turned = rotate_points(jnp.asarray(cloud), jnp.float32(angle))
        np.testing.assert_array_equal(descriptor, np.asarray(rasterize(turned, grid=GRID)).reshape(-1))
    assert found.config == {"data": "08", "method": "pixels", "rotation_seed": 3}
    other = embed_images(flatten, scans, GRID, config={}, rotation_seed=4)
    assert (other.descriptors != found.descriptors).any(axis=1).all()


def test_images_are_turned_whole_and_cropped_to_the_grid(pictures):
    every = np.stack([pictures.image(i) for i in range(SCANS)])
    whole = embed_images(flatten, pictures, None, config={})
    np.testing.assert_array_equal(whole.descriptors, every.reshape(SCANS, -1))
    cropped = embed_images(flatten, pictures, GRID, config={})
    np.testing.assert_array_equal(cropped.descriptors, every[:, 2:18, 4:20].reshape(SCANS, -1))
    turned = embed_images(flatten, pictures, GRID, config={}, rotation_seed=3)
    expected = rotate_image(jnp.asarray(every), jnp.asarray(drawn_angles(3)))[:, 2:18, 4:20]
    np.testing.assert_allclose(turned.descriptors, expected.reshape(SCANS, -1), atol=1e-4)
    assert turned.times is None


@pytest.mark.parametrize(("batch", "size"), [(3, 3), (64, 8)])
def test_the_batches_do_not_show_and_are_all_of_one_shape(scans, batch, size):
    shapes, done = set(), []

    def describe(images):
        shapes.add(images.shape)
        return flatten(images)

    found = embed_images(describe, scans, GRID, config={}, batch=batch, on_progress=done.append)
    np.testing.assert_array_equal(found.descriptors, embed_images(flatten, scans, GRID, config={}).descriptors)
    with pytest.raises(ValueError, match=r"batch: expected a number from 1 .*found 0"):
        embed_images(flatten, scans, GRID, config={}, batch=0)
    assert shapes == {(size, GRID.height, GRID.width)} and done == [*range(1, SCANS + 1)]


def test_ready_made_images_that_are_none_of_densities_are_refused_where_these_are_wanted(pictures):
    """Grey values, say: float values from 0 to 10 are counts of voxels."""
    values = {path: pictures.image(row) * np.float32(25.5) for row, path in enumerate(PICTURES)}
    others = of_images(values, name="06")
    with pytest.raises(ValueError, match=r"scan 000000 of sequence 06: expected a density image, floats from 0 to 10"):
        embed_images(flatten, others, GRID, config={}, image="density")
    reported = []
    with pytest.raises(ValueError, match="at least one readable scan"):
        embed_images(flatten, others, GRID, config={}, image="density", on_bad_scan=lambda *bad: reported.append(bad))
    assert len(reported) == SCANS


def test_bad_scans_are_reported_and_left_out_if_asked(scans):
    reported = []
    found = embed_images(
        flatten,
        with_bad_scan(scans, 2, 6),
        GRID,
        config={},
        rotation_seed=3,
        batch=4,
        on_bad_scan=lambda name, error: reported.append((name, str(error))),
    )
    kept = [0, 1, 3, 4, 5]
    assert reported == [("000004", "000004.bin: not a whole scan"), ("000012", "000012.bin: not a whole scan")]
    assert found.ids == tuple(scans.ids[i] for i in kept)
    np.testing.assert_array_equal(found.positions, scans.positions[kept])
    np.testing.assert_array_equal(found.times, scans.times[kept])
    everything = embed_images(flatten, scans, GRID, config={}, rotation_seed=3)
    np.testing.assert_array_equal(found.descriptors, everything.descriptors[kept])  # the others keep their angles


def test_with_categories_every_scan_comes_with_its_map_turned_as_the_image_is(scans, tmp_path):
    raw = [np.resize(np.array([10, 50, 252], "<u4"), len(cloud)) for cloud in clouds()]
    labelled = with_labels(scans, raw, tmp_path)

    def maps(images, labels):
        assert images.shape == labels.shape == (3, GRID.height, GRID.width)
        return flatten(labels)

    found = embed_images(maps, labelled, GRID, config={}, categories=25, rotation_seed=3, batch=3)
    for cloud, ids, angle, descriptor in zip(clouds(), raw, drawn_angles(3), found.descriptors, strict=True):
        turned = rotate_points(jnp.asarray(cloud), jnp.float32(angle))
        classes = jnp.asarray(to_classes(ids.astype(np.int32), categories=25))
        expected = rasterize_labels(turned, classes, grid=GRID)
        assert expected.max() == 25  # the moving car
        np.testing.assert_array_equal(descriptor, np.asarray(expected).reshape(-1))
    with pytest.raises(ValueError, match="pixels needs labels beside the scans, found none in sequence 08"):
        embed_images(maps, scans, GRID, config={}, categories=25)


def test_points_are_described_scan_by_scan(scans):
    seen = []
    found = embed_scans(mean_point, scans, distance="cosine", on_progress=seen.append)
    np.testing.assert_array_equal(found.descriptors, [cloud.mean(axis=0) for cloud in clouds()])
    assert (found.distance, found.weights_hash, found.ids, seen) == ("cosine", "", scans.ids, [*range(1, SCANS + 1)])
    assert found.config == {"data": "08", "method": "mean", "rotation_seed": None}


def mean_of(scan):
    return scan.upright_points.mean(axis=0)


def test_an_untrained_network_does_not_have_the_hash_of_a_teacher():
    taught = Params({}, dataclasses.replace(model_preset("tiny"), descriptors_of="a teacher"))
    assert method_beside(taught, "untrained", ready_made=False, seed=0).weights_hash != "a teacher"


def learned(prepare=mean_of, describe=lambda inputs: inputs, takes="points") -> Method:
    """A method with weights."""

    def prepared(scan, angle):
        return prepare(scan if angle is None else rotated_scan(scan, angle))

    return Method({"method": "mine"}, takes, prepared, describe, weights_hash="hash")


@pytest.mark.parametrize(("value", "words"), [(np.nan, "values that are not finite"), (0, "only zeros")])
def test_invalid_descriptors_are_one_line_errors(scans, value, words):
    def prepare(scan):
        return np.full(3, value if "000006" in scan.name else 1, np.float32)

    with pytest.raises(ValueError, match=f"^mine: expected a descriptor of scan 000006 of sequence .*{words}$"):
        embed(learned(prepare), scans)


def test_other_lengths_from_scan_to_scan_are_errors(scans):
    odd = learned(lambda scan: np.ones(4 if "000006" in scan.name else 3, np.float32))
    with pytest.raises(ValueError, match=r"mine: expected an input \(3,\) of scan 000006 .*found \(4,\)"):
        embed(odd, scans)
    with pytest.raises(ValueError, match="mine: expected 7 descriptors"):
        embed(learned(describe=lambda inputs: np.ones((len(inputs), 2, 2))), scans)
