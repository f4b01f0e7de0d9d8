"""Corruptions of clouds against numpy loops, the rings of a scan, and corrupted recordings."""

import math

import hypothesis.extra.numpy as hnp
import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from recordings import of_scans

from sglpr_jax.data.corruption import (
    CORRUPTIONS,
    ROTATION,
    Corruption,
    corrupt,
    corruption_named,
    is_on_kept_ring,
    ring_numbers,
)
from sglpr_jax.data.corruption import corrupted as corrupted_recording
from sglpr_jax.data.formats.scan_files import scan_of_file
from sglpr_jax.data.readers import open_recording
from sglpr_jax.sim.sensor import HDL64E_DEG

coordinates = st.one_of(st.just(0.0), st.floats(0.125, 100, width=32), st.floats(-100, -0.125, width=32))
clouds = st.integers(0, 40).flatmap(lambda n: hnp.arrays(np.float32, (n, 3), elements=coordinates))
seeds = st.integers(0, 2**32 - 1)
any_cloud = settings(deadline=None, max_examples=50)


def corrupted(points, kind, strength, seed=0):
    return corrupt(points, Corruption(kind, strength), rng=np.random.default_rng(seed))


def reference(points, kind, strength, rng):
    """Each corruption, point by point: the points, and which remain."""
    n, points = len(points), points.astype(float)
    if kind == "occlusion":
        heading = rng.uniform(-np.pi, np.pi)
        away = [math.degrees(math.acos(np.clip(math.cos(math.atan2(y, x) - heading), -1, 1))) for x, y, _ in points]
        assume(all(abs(angle - strength / 2) > 1e-3 for angle in away))
        return points, np.array([angle > strength / 2 for angle in away], bool)
    if kind == "noise":
        steps = strength * rng.standard_normal(n)
        distances = [math.hypot(*point) for point in points]
        moved = [p * (d + s) / d if d else p for p, d, s in zip(points, distances, steps, strict=True)]
        return np.reshape(moved, (n, 3)), np.ones(n, bool)
    if kind == "dropout":
        return points, rng.random(n) >= strength
    return points - [0, rng.choice((-1, 1)) * strength, 0], np.ones(n, bool)


@pytest.mark.slow
@pytest.mark.parametrize(("kind", "most"), [("occlusion", 359), ("noise", 2), ("dropout", 1), ("offset", 5)])
@any_cloud
@given(points=clouds, seed=seeds, share=st.floats(0.01, 1))
def test_corruptions_are_those_of_a_plain_loop(kind, most, points, seed, share):
    left, kept = corrupted(points, kind, share * most, seed)
    moved, remain = reference(points, kind, share * most, np.random.default_rng(seed))
    np.testing.assert_array_equal(kept, remain)
    np.testing.assert_allclose(left, moved[kept], rtol=1e-5, atol=1e-5)


def test_names_say_kind_and_strength():
    assert [corruption_named(corruption.name) for corruption in CORRUPTIONS] == list(CORRUPTIONS)
    assert corruption_named("occlusion-60") == Corruption("occlusion", 60.0)
    with pytest.raises(ValueError, match=r"a corruption such as rotation, .*, found 'beams'; did you mean 'beams-"):
        corruption_named("beams")
    with pytest.raises(ValueError, match="noise-loud: could not convert"):
        corruption_named("noise-loud")
    with pytest.raises(ValueError, match=r"expected dropout with a strength from . to .*, found 1\.5"):
        Corruption("dropout", 1.5)


def turn(elevations_deg, *, azimuths=90, wobble_deg=0.0, seed=0):
    """Points of one turn, ring after ring from the highest, and the number of each point's ring from the lowest."""
    rng = np.random.default_rng(seed)
    elevation = np.radians(np.sort(elevations_deg)[::-1])[:, None]
    azimuth = (np.arange(azimuths) + 0.5)[None, :] * (2 * np.pi / azimuths)
    elevation = elevation + np.radians(wobble_deg) * np.sin(azimuth)
    distance = rng.uniform(3, 60, elevation.shape if wobble_deg else (len(elevation), azimuths))
    rays = [np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation) + 0 * azimuth]
    points = np.stack([distance * axis for axis in rays], axis=-1).reshape(-1, 3).astype(np.float32)
    return points, np.repeat(np.arange(len(elevation))[::-1], azimuths)


@pytest.mark.slow
@settings(deadline=None, max_examples=20)
@given(st.integers(0, 2**32 - 1), st.integers(1, 64))
def test_separate_elevations_give_the_rings_in_any_order(seed, rings):
    points, expected = turn(HDL64E_DEG[:rings], seed=seed)
    order = np.random.default_rng(seed).permutation(len(points))
    np.testing.assert_array_equal(ring_numbers(points[order]), expected[order])


def test_overlapping_rings_are_separated_by_the_order_of_points_or_laser_numbers():
    points, expected = turn(HDL64E_DEG, wobble_deg=0.5)
    sample = np.random.default_rng(0).random(len(points)) < 0.7
    np.testing.assert_array_equal(ring_numbers(points[sample]), expected[sample])
    order, names = np.random.default_rng(0).permutation(len(points)), np.random.default_rng(1).permutation(64) + 7
    found = ring_numbers(points[order], lasers=names[expected[order]])
    np.testing.assert_array_equal(found, expected[order])


def test_points_without_rings_are_refused():
    points = np.random.default_rng(0).permutation(turn(HDL64E_DEG, wobble_deg=0.5)[0])
    with pytest.raises(ValueError, match=rf"expected a scan with rings .* found {len(points)} points without"):
        ring_numbers(points)


@pytest.mark.parametrize(("found", "beams", "every"), [(64, 32, 2), (61, 16, 4), (16, 16, 1)])
def test_every_second_or_fourth_ring_is_kept(found, beams, every):
    rings = np.random.default_rng(0).permutation(np.repeat(np.arange(found), 5))
    kept = is_on_kept_ring(rings, beams)
    assert sorted(set(rings[kept])) == list(range(0, found, every))
    assert set(rings[~kept]) == set(range(found)) - set(range(0, found, every))


def test_real_scans(shared):
    samples = shared / "data/samples"
    (nclt,) = (samples / "nclt/velodyne_sync").glob("*.bin")
    kitti = next((shared / "data/kitti_odometry/sequences/00/velodyne").glob("*.bin"))
    nuscenes = samples / "nuscenes_32_beams.pcd.bin"
    for path, expected in ((nclt, 32), (nuscenes, 32), (samples / "16_beams.pcd", 16), (kitti, 64)):
        found = scan_of_file(path)
        points, lasers = found.points, found.lasers
        finite = np.isfinite(points).all(axis=1)
        rings = ring_numbers(points[finite], lasers=None if lasers is None else lasers[finite])
        assert set(rings) == set(range(expected)), path


ON_POINTS = list({one.kind: one for one in CORRUPTIONS if one != ROTATION}.values())
by_name = pytest.mark.parametrize("corruption", ON_POINTS, ids=lambda corruption: corruption.name)


@pytest.fixture(scope="module")
def rings_recording(tmp_path_factory):
    """Four scans of 64 rings of 30 points, each point with a label of its own."""
    folder, (ray, _) = tmp_path_factory.mktemp("rings"), turn(np.linspace(2, -24, 64), azimuths=30)
    paths = tuple(folder / f"{i}.label" for i in range(4))
    for path in paths:
        np.arange(len(ray), dtype="<u4").tofile(path)
    scale = [np.random.default_rng(i).uniform(0.5, 1.5, (len(ray), 1)) for i in range(4)]
    return of_scans({path: (ray * s).astype("f4") for path, s in zip(paths, scale, strict=True)}, label_paths=paths)


@by_name
def test_a_scan_is_corrupted_by_seed_and_row_alone_and_labels_stay_with_their_points(rings_recording, corruption):
    points, labels = rings_recording.points(1), rings_recording.labels(1)
    found = corrupted_recording(rings_recording, corruption, seed=3)
    forwards = [found.points(i) for i in range(4)]
    left, kept = forwards[1], found.labels(1)
    assert not np.array_equal(left, points)
    # A label is its point's row.
    np.testing.assert_array_equal(*((left, points[kept]) if len(left) < len(points) else (kept, labels)))
    again = corrupted_recording(rings_recording, corruption, seed=3)
    for i in reversed(range(4)):
        np.testing.assert_array_equal(again.points(i), forwards[i])
    if corruption.kind in ("occlusion", "noise", "dropout"):
        assert not np.array_equal(corrupted_recording(rings_recording, corruption, seed=4).points(0), forwards[0])


def test_points_that_are_not_finite_go_with_their_labels(kitti_root):
    path = kitti_root / "sequences" / "08" / "velodyne" / "000000.bin"
    records = np.fromfile(path, "<f4").reshape(-1, 4)
    records[1, 2] = np.nan
    records.tofile(path)
    found = corrupted_recording(open_recording(kitti_root, "08"), Corruption("offset", 1.0), seed=0)
    assert np.isfinite(found.points(0)).all()
    np.testing.assert_array_equal(found.labels(0), [48, 50, 51, 52])
    assert found.labels(1) is None


def test_images_have_no_points(bev_root):
    with pytest.raises(ValueError, match=r"beams-16 needs points, found only images in sequence 06.*rotation"):
        corrupted_recording(open_recording(bev_root, "06"), Corruption("beams", 16.0), seed=0)
