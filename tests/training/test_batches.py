"""A batch has the content of the files, and its views are the rasterised rotated points (equation 1)."""

import dataclasses
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from PIL import Image
from recordings import of_images, of_scans

from sglpr_jax.bev import even_cells, rasterize, rasterize_labels, rotate_image, rotate_labels
from sglpr_jax.data.density_image import density_bev, density_label_image
from sglpr_jax.data.formats.png import label_image_pixels
from sglpr_jax.data.recording import Recording
from sglpr_jax.grid import Grid
from sglpr_jax.labels import to_classes
from sglpr_jax.methods.recipe import TupleConfig
from sglpr_jax.training.batch_source import training_batches
from sglpr_jax.training.batches import Batch, mix, read_batch, views
from sglpr_jax.training.tuples import TuplePool, tuple_pool

GRID = Grid(resolution_m=1.0, height=16, width=16)
RAW_LABELS = np.array([40, 10, 70, 252, 0], np.uint32)
STEP_M = 2.0
SIZES = (6, 9, 3, 9, 5, 8, 9, 4, 9, 7, 9, 9, 9, 9, 9, 9)


def clouds(seed: int) -> list[np.ndarray]:
    rng = np.random.default_rng(seed)
    return [rng.uniform(-9, 9, (n, 3)).astype(np.float32) for n in SIZES]


def positions() -> np.ndarray:
    """A straight recording with 2 m between frames, so that only the next frame is a positive."""
    return np.column_stack([np.arange(len(SIZES)) * STEP_M, np.zeros((len(SIZES), 2))])


def labels_of(cloud: np.ndarray) -> np.ndarray:
    return RAW_LABELS[np.arange(len(cloud)) % len(RAW_LABELS)]


def scan_sequence(folder: Path, scans: list[np.ndarray], *, labelled: bool) -> Recording:
    """A recording with scans in memory and label files on disk."""
    folder.mkdir()
    by_path = {folder / f"{i:06d}.bin": cloud for i, cloud in enumerate(scans)}
    label_paths = tuple(path.with_suffix(".label") if labelled else None for path in by_path)
    for path, cloud in zip(label_paths, scans, strict=True):
        if path is not None:
            labels_of(cloud).tofile(path)
    return of_scans(by_path, name=folder.name, positions=positions(), label_paths=label_paths)


@pytest.fixture
def recordings(tmp_path) -> list[Recording]:
    """A recording with labels and one without."""
    return [
        scan_sequence(tmp_path / name, clouds(seed), labelled=labelled)
        for seed, (name, labelled) in enumerate([("00", True), ("05", False)])
    ]


@pytest.fixture
def pool(recordings) -> TuplePool:
    return TuplePool([recording.positions for recording in recordings], TupleConfig(positives=1, negatives=2))


FRAMES = np.array([[0, 1, 12, 20], [18, 17, 5, 31]])


def read(recordings, pool, frames=FRAMES, *, max_points=9, share_negatives=False):
    return read_batch(recordings, pool, frames, max_points=max_points, share_negatives=share_negatives)


def test_clouds_are_padded_and_the_valid_points_counted(recordings, pool):
    batch = read(recordings, pool, max_points=12)
    every = clouds(0) + clouds(1)
    assert batch.points.shape == (8, 12, 3) and batch.images is None
    for row, frame in enumerate(FRAMES.reshape(-1)):
        n = len(every[frame])
        assert batch.count[row] == n
        np.testing.assert_array_equal(batch.points[row, :n], every[frame])
        np.testing.assert_array_equal(batch.points[row, n:], 0)
        expected = to_classes(labels_of(every[frame]).astype(np.int32)) if frame < len(SIZES) else 0
        np.testing.assert_array_equal(batch.classes[row, :n], expected)
    np.testing.assert_array_equal(batch.labelled, FRAMES.reshape(-1) < len(SIZES))


def test_large_clouds_are_thinned_evenly_with_their_labels(recordings, pool):
    batch = read(recordings, pool, max_points=5)
    np.testing.assert_array_equal(batch.count, [min(n, 5) for n in np.tile(SIZES, 2)[FRAMES.reshape(-1)]])
    kept = [0, 2, 4, 6, 8]  # of the nine points of frame 1
    np.testing.assert_array_equal(batch.points[1], clouds(0)[1][kept])
    np.testing.assert_array_equal(batch.classes[1], to_classes(labels_of(clouds(0)[1]).astype(np.int32))[kept])


@pytest.mark.parametrize("share_negatives", [False, True])
def test_the_negatives_of_each_anchor_are_those_of_brute_force(recordings, pool, share_negatives):
    frames = np.array([[0, 1, 12, 5], [3, 4, 15, 31], [18, 17, 5, 30]])  # frame 5 is too near to the first anchor
    batch = read(recordings, pool, frames, share_negatives=share_negatives)
    expected = np.zeros((3, 12), bool)
    every = np.concatenate([positions(), positions()])
    for t, anchor in enumerate(frames[:, 0]):
        for place, frame in enumerate(frames.reshape(-1)):
            other_drive = (anchor < len(SIZES)) != (frame < len(SIZES))
            far = other_drive or np.linalg.norm(every[anchor] - every[frame]) > 20
            own = place // 4 == t and place % 4 >= 2
            expected[t, place] = far and (own or share_negatives)
    np.testing.assert_array_equal(batch.negatives, expected)
    assert batch.negatives.sum() == (21 if share_negatives else 5)
    assert batch.positives == 1


@pytest.mark.parametrize("share_negatives", [False, True])
def test_the_parts_of_two_hosts_are_the_whole_batch(recordings, pool, share_negatives):
    options = {"max_points": 9, "share_negatives": share_negatives}
    whole = read_batch(recordings, pool, FRAMES, **options)
    parts = [read_batch(recordings, pool, FRAMES, **options, part=slice(i, i + 1)) for i in range(2)]
    assert parts[0].negatives.shape == (1, 8) and parts[0].points.shape == (4, 9, 3)
    assert parts[1].classes is not None  # the second host reads the second recording alone, which has no labels
    joined = jax.tree.map(lambda *rows: np.concatenate(rows), *parts)
    jax.tree.map(np.testing.assert_array_equal, joined, whole)


@pytest.mark.slow
def test_views_are_the_rasterised_turned_points(recordings, pool):
    batch = read(recordings, pool)
    angles = np.random.default_rng(0).uniform(0, 2 * np.pi, 8).astype(np.float32)
    images, maps = jax.jit(views, static_argnames="grid")(batch, jnp.asarray(angles), grid=GRID)
    assert images.dtype == jnp.float32
    every = clouds(0) + clouds(1)
    for row, frame in enumerate(FRAMES.reshape(-1)):
        x, y, z = every[frame].T
        cos, sin = np.cos(angles[row]), np.sin(angles[row])
        turned = jnp.asarray(np.stack([cos * x - sin * y, sin * x + cos * y, z], axis=-1))
        classes = jnp.asarray(to_classes(labels_of(every[frame]).astype(np.int32)) * (frame < len(SIZES)))
        np.testing.assert_array_equal(images[row], rasterize(turned, grid=GRID))
        np.testing.assert_array_equal(maps[row], rasterize_labels(turned, classes, grid=GRID))
    assert images.sum() > 0 and maps.sum() > 0


def image_drive(folder: Path, *, labelled: range) -> Recording:
    """Images in memory, and label images on disk of some: a car wherever the image is above 5."""
    folder.mkdir()
    pictures = np.random.default_rng(len(folder.name)).uniform(0, 10, (len(SIZES), 20, 22)).astype(np.float32)
    label_paths = tuple(folder / f"{i:06d}.png" if i in labelled else None for i in range(len(SIZES)))
    for path, picture in zip(label_paths, pictures, strict=True):
        if path is not None:
            Image.fromarray(label_image_pixels(np.where(picture > 5, 252, 0))).save(path)
    by_path = {Path(f"{i:06d}.png"): picture for i, picture in enumerate(pictures)}
    return of_images(by_path, name=folder.name, positions=positions(), label_paths=label_paths)


@pytest.mark.parametrize(("categories", "moving_car"), [(20, 1), (25, 25)])
def test_a_batch_of_images_has_the_label_maps_of_labelled_ones(pool, tmp_path, categories, moving_car):
    recordings = [image_drive(tmp_path / "06", labelled=range(3)), image_drive(tmp_path / "07", labelled=range(0))]
    options = {"max_points": 9, "share_negatives": False}
    batch = read_batch(recordings, pool, FRAMES, **options, categories=categories)
    np.testing.assert_array_equal(batch.labelled, FRAMES.reshape(-1) < 3)
    assert batch.labelled.any() and batch.maps.dtype == np.int32
    expected = np.where(batch.images > 5, moving_car, 0) * batch.labelled[:, None, None]
    np.testing.assert_array_equal(batch.maps, expected)
    alone = read_batch(
        recordings, pool, FRAMES, **options, part=slice(1, 2)
    )  # without one labelled frame, as another host
    assert alone.maps is not None and not alone.labelled.any()

    unread = read_batch(recordings, pool, FRAMES, **options, categories=0)
    assert unread.maps is None and not unread.labelled.any()
    bare = read_batch(recordings[1:] * 2, pool, FRAMES, **options)
    assert bare.maps is None and not bare.labelled.any()


def test_maps_are_turned_and_cropped_with_their_images(pool, tmp_path):
    recordings = [image_drive(tmp_path / name, labelled=range(99)) for name in ("06", "07")]
    batch = read(recordings, pool)
    angles = np.random.default_rng(0).uniform(0, 2 * np.pi, 8).astype(np.float32)
    images, maps = jax.jit(views, static_argnames="grid")(batch, jnp.asarray(angles), grid=GRID)
    assert images.shape == maps.shape == (8, 16, 16)
    np.testing.assert_allclose(images, rotate_image(jnp.asarray(batch.images), angles)[:, 2:18, 3:19], atol=1e-4)
    np.testing.assert_array_equal(maps, rotate_labels(jnp.asarray(batch.maps), angles)[:, 2:18, 3:19])
    same_angle = np.asarray(images)[np.asarray(maps) == 1].mean()
    assert same_angle > 5.5 > 4.5 > np.asarray(images)[np.asarray(maps) == 0].mean()


@pytest.mark.slow
def test_scans_become_density_images_of_all_their_points(recordings, pool):
    bare, frames = recordings[1], np.array([[0, 1, 12, 13]])
    alone = TuplePool([bare.positions], TupleConfig(negatives=2))
    batch = read_batch([bare], alone, frames, max_points=2, share_negatives=False, image="density")
    assert batch.points is None and not batch.labelled.any() and batch.places == 4
    np.testing.assert_array_equal(batch.images, [density_bev(clouds(1)[frame]) for frame in frames[0]])
    assert batch.images.sum() > 0
    middle = even_cells(jnp.asarray(batch.images))[:, 68:84, 68:84]
    np.testing.assert_allclose(views(batch, jnp.zeros(4), GRID)[0], middle, atol=1e-4)
    labelled = read_batch(recordings, pool, FRAMES, max_points=9, share_negatives=False, image="density")
    for row, frame in enumerate(FRAMES.reshape(-1)):
        recording, number = recordings[int(pool.recording_of[frame])], int(pool.frame_of[frame])
        assert labelled.labelled[row] == (recording.labels(number) is not None)
        if labelled.labelled[row]:
            classes = to_classes(recording.labels(number))
            found = density_label_image(recording.points(number), classes)
            np.testing.assert_array_equal(labelled.maps[row], np.rot90(found, -1))


def test_images_of_two_sizes_are_refused(pool):
    sizes = {"00": (16, 16), "05": (12, 20)}
    mixed = [
        of_images({Path(f"{name}-{i}.png"): np.zeros(size, np.float32) for i in range(len(SIZES))}, name=name)
        for name, size in sizes.items()
    ]
    words = "recording 05, frame 05-1: expected an image of 16 x 16 pixels, as in 00, found 12 x 20"
    with pytest.raises(ValueError, match=words):
        read(mixed, pool, np.array([[0, 1, 17, 2]]))


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


def test_views_of_a_mixed_batch_are_those_of_the_first_and_then_the_second():
    mixed = mix(SCANS, IMAGES, triplets=False, share_negatives=True)
    angles = jnp.asarray(RNG.uniform(0, 6, SCANS.places + IMAGES.places).astype(np.float32))
    images, maps = views(mixed, angles, GRID)
    parts = views(SCANS, angles[: SCANS.places], GRID), views(IMAGES, angles[SCANS.places :], GRID)
    np.testing.assert_array_equal(images, np.concatenate([image for image, _ in parts]))
    expected = [np.zeros(image.shape) if part is None else part for image, part in parts]
    np.testing.assert_array_equal(maps, np.concatenate(expected))
    assert np.asarray(maps).max() > 0
    np.testing.assert_array_equal(mixed.labelled, np.r_[SCANS.labelled, IMAGES.labelled])


@pytest.mark.parametrize("share_negatives", [False, True])
def test_tuples_of_both_datasets_share_negatives_only_if_asked(share_negatives):
    alone = mix(IMAGES, SCANS, triplets=False, share_negatives=share_negatives)
    np.testing.assert_array_equal(alone.negatives, IMAGES.negatives)  # places for the segmentation are no negatives
    negatives = mix(IMAGES, SCANS, triplets=True, share_negatives=share_negatives).negatives
    assert negatives.shape == (3, 9)
    np.testing.assert_array_equal(negatives[:2, :6], IMAGES.negatives)
    np.testing.assert_array_equal(negatives[2:, 6:], SCANS.negatives)
    assert (negatives[:2, 6:] == share_negatives).all() and (negatives[2:, :6] == share_negatives).all()


def straight(name: str) -> Recording:
    """Scans that are not read, 2 m apart."""
    positions = np.column_stack([2.0 * np.arange(40), np.zeros((40, 2))])
    return of_scans({Path(f"{name}-{i}.bin"): np.zeros((3, 3)) for i in range(40)}, name=name, positions=positions)


@pytest.mark.parametrize("triplets", [False, True])
def test_scan_names_are_those_of_both_datasets(config, triplets):
    config = dataclasses.replace(config, also_tuples=1, also_triplets=triplets)
    main, also = [straight("00")], [straight("town")]
    batches = training_batches(main, tuple_pool(main, config.sampling), config, also=also)
    pool = tuple_pool(also, config.sampling)
    draw = pool.draw if triplets else pool.draw_places
    for step in range(3):
        first, second = batches.scan_names(step).split("; ")
        assert first.startswith("recording 00 frames 00-")
        frames = np.unique(draw(seed=config.seed, step=step, tuples=1))
        assert second == f"recording town frames {' '.join(f'town-{frame}' for frame in frames)}"
