"""Stored scans: images that were compressed come back, in less memory, and a limited number is kept."""

import dataclasses

import numpy as np
import pytest
from scenes import place, seen_from

from sglpr_jax.loops import keyframes
from sglpr_jax.loops.config import DetectorConfig
from sglpr_jax.loops.detector import LoopDetector
from sglpr_jax.loops.keyframes import StoredScans
from sglpr_jax.registration.bev_spectra import match_spectra
from sglpr_jax.retrieval.index import Index
from sglpr_jax.se3 import inverse


def images(count: int) -> list[np.ndarray]:
    """Sparse images of one place."""
    return [seen_from(place(), (0.1 * k, 0.0, 0.0), seed=k).astype(np.uint8) for k in range(count)]


def stored_of(given: list[np.ndarray]) -> StoredScans:
    stored = StoredScans(Index.empty(4))
    for k, image in enumerate(given):
        stored.add(10 * k, np.full(4, k, np.float32), image)
    return stored


def test_images_come_back_in_a_fraction_of_the_memory():
    given = images(40)
    stored = stored_of(given)
    for k, image in enumerate(given):
        np.testing.assert_array_equal(stored.image(k), image)
    assert len(stored) == 40 and stored.frames.tolist() == list(range(0, 400, 10))
    assert stored.nbytes - stored_of(given[:1]).nbytes < 40 * given[0].nbytes / 3


def test_an_image_of_another_size_is_one_clear_error():
    stored = stored_of(images(1))
    with pytest.raises(ValueError, match=r"frame 3: expected an image of \(64, 64\) cells, found \(8, 8\)"):
        stored.add(3, np.zeros(4, np.float32), np.zeros((8, 8), np.uint8))
    assert len(stored) == 1 == len(stored.index)


def exact(stored: StoredScans, rows: list[int]) -> np.ndarray:
    return np.stack([spectra.exact for spectra in stored.spectra(np.array(rows))])


def test_spectra_are_those_of_the_images_and_only_the_last_used_are_kept(monkeypatch):
    monkeypatch.setattr(keyframes, "SPECTRA", 3)
    given = images(5)
    stored, expected = stored_of(given), np.asarray(match_spectra(np.stack(given)))
    for rows in ([0, 1, 2, 3, 4], [4, 0], [1]):
        np.testing.assert_allclose(exact(stored, rows), expected[rows], atol=1e-5)
        assert len(stored._spectra) == 3
    stored.forget(2)
    np.testing.assert_allclose(exact(stored, [0, 2]), expected[[2, 4]], atol=1e-5)


def test_scans_with_a_loop_to_a_newer_one_are_forgotten_first_then_the_oldest():
    stored = StoredScans(Index.empty(1))
    for frame in range(0, 100, 10):
        stored.add(frame, np.array([frame], np.float32), np.full((2, 2), frame, np.uint8))
    stored.close_loop(90, 40)
    stored.close_loop(95, 20)  # 95 is not stored, so nothing represents the place of 20
    stored.close_loop(80, 45)
    stored.forget(1)
    assert stored.frames.tolist() == [0, 10, 20, 30, 50, 60, 70, 80, 90]
    stored.forget(2)
    assert stored.frames.tolist() == [20, 30, 50, 60, 70, 80, 90]
    assert [int(stored.image(row)[0, 0]) for row in range(7)] == stored.frames.tolist()
    assert stored.index.query([52.0]).rows.tolist() == [2]
    stored.add(100, np.array([52], np.float32), np.full((2, 2), 100, np.uint8))
    assert stored.index.query([52.0]).rows.tolist() == [7] and stored.index.ids[-1] == "000100"


def pairs(detector: LoopDetector) -> list[tuple]:
    return [(one.query, one.match, one.probability, one.match_from_query.tobytes()) for one in detector.loops]


@pytest.mark.slow
def test_loops_with_limits_are_right_and_limits_that_are_not_reached_change_nothing(
    params, street, described, streamed
):
    whole, poses = streamed[0], street.poses.world_from_lidar

    def searched(**limits) -> LoopDetector:
        detector = LoopDetector(params, config=DetectorConfig(**limits))
        for keyframe, time, pose in zip(described, street.times.tolist(), poses, strict=True):
            detector.add_keyframe(keyframe, time=time, odometry=pose)
            assert len(detector.finder.stored) <= limits["max_places"]
        return detector

    same = searched(keyframe_m=0.0, max_places=len(street))
    assert pairs(same) == pairs(whole) and len(whole.finder.stored) == len(street)
    few = searched(keyframe_m=5.0, max_places=15)
    stored = few.finder.stored
    assert len(stored) > 10 and few.finder.index.ids == [f"{frame:06d}" for frame in stored.frames]
    for loop in few.loops:
        error = inverse(inverse(poses[loop.match]) @ poses[loop.query]) @ loop.match_from_query
        assert np.linalg.norm(error[:2, 3]) < 2
    assert len({loop.query for loop in few.loops}) > len(whole.loops) / 3
    assert few.nbytes < whole.nbytes
    same.config = dataclasses.replace(same.config, max_places=3)
    same.add_keyframe(None, time=float(street.times[-1]) + 1, odometry=poses[-1])
    assert len(same.candidates) == 3 and pairs(same) == pairs(whole)  # loops are never forgotten


@pytest.mark.parametrize(
    ("limits", "message"),
    [
        ({"max_places": 0}, "DetectorConfig.max_places: expected a number from 1 .*, found 0"),
        ({"keyframe_m": np.nan}, "DetectorConfig.keyframe_m: expected a finite number, found nan"),
    ],
)
def test_invalid_limits_are_one_clear_error(limits, message):
    with pytest.raises(ValueError, match=message):
        dataclasses.replace(DetectorConfig(), **limits)
