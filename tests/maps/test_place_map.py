"""A map is kept, merged and asked; scans that it has not seen find themselves."""

import dataclasses
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
from recordings import with_points
from scipy.spatial.distance import cdist
from scipy.spatial.transform import Rotation

from sglpr_jax.data.mounting import Mounting
from sglpr_jax.data.scan import Scan
from sglpr_jax.data.views import rotated
from sglpr_jax.maps.build import map_recording
from sglpr_jax.maps.place_map import PlaceMap
from sglpr_jax.retrieval.index import Index
from sglpr_jax.same_place import NEGATIVE_M
from sglpr_jax.se3 import inverse, yaw_of

PLACES = 10


@pytest.mark.slow
def test_scans_between_those_of_the_map_find_themselves_and_one_from_elsewhere_does_not(drive, places, params):
    for frame in (10, 18, 30):
        angle = 2.0 + frame
        found = places.relocate(params, Scan(points=rotated(drive.points(frame), angle)))
        true = drive.poses.world_from_lidar[frame]
        error = inverse(true) @ found[0].world_from_query
        assert found[0].probability > 0.5 and np.linalg.norm(error[:2, 3]) < 0.4
        assert abs(np.angle(np.exp(1j * (yaw_of(error) + angle)))) < np.radians(2)
        assert found[0].place in (f"08/{drive.ids[frame - 2]}", f"08/{drive.ids[frame + 2]}")
        assert [one.probability for one in found] == sorted((one.probability for one in found), reverse=True)
        positions = np.array([one.world_from_query[:3, 3] for one in found])
        assert (cdist(positions, positions) + 1e3 * np.eye(len(found)) > NEGATIVE_M).all()
        assert sum(one.probability for one in found) < 1 + 1e-9
    assert np.linalg.norm(drive.positions[120] - drive.positions[:40], axis=1).min() > 40
    assert all(one.probability < 0.5 for one in places.relocate(params, drive.scan(120)))


@pytest.mark.slow
def test_a_map_comes_back_from_its_file(places, tmp_path):
    path = tmp_path / "town.safetensors"
    places.save(path)
    again = PlaceMap.load(path, weights_hash=places.index.weights_hash)
    assert len(again) == len(places) == PLACES and again.index.ids == places.index.ids
    np.testing.assert_array_equal(again.images, places.images)
    np.testing.assert_array_equal(again.world_from_place, places.world_from_place)


@pytest.mark.slow
def test_two_days_are_merged_and_places_that_both_have_are_taken_once(drive, first, places, params):
    shifted = first[1].copy()
    shifted[:, 2, 3] += 1.0
    ids = [name.replace("08/", "sunday/") for name in places.index.ids]
    index = Index.empty(places.index.width, weights_hash=places.index.weights_hash)
    index.add(places.index.descriptors, ids=ids, positions=shifted[:, :3, 3])
    other = dataclasses.replace(places, index=index, world_from_place=shifted)
    both = places.merged(other)
    assert both.index.ids == places.index.ids + ids
    np.testing.assert_array_equal(both.index.positions, both.world_from_place[:, :3, 3])
    np.testing.assert_array_equal(both.world_from_place[PLACES:], shifted)
    for places_of, name in ((both, "08"), (other, "sunday")):  # both days have the place: one answer
        (found,) = places_of.relocate(params, drive.scan(20), candidates=2)
        assert found.place.split("/")[0] == name and found.probability > 0.5

    again = both.merged(places).merged(other)
    assert again.index.to_bytes() == both.index.to_bytes()
    np.testing.assert_array_equal(again.images, both.images)
    moved = dataclasses.replace(places, world_from_place=shifted + np.eye(4, k=3)[None])
    three = both.merged(moved)  # of another recording that is called 08 too
    assert three.index.ids[len(both) :] == [name.replace("08/", "08~2/") for name in places.index.ids]
    assert three.merged(moved).index.ids == three.index.ids


def synthetic(scans: Sequence[int], *, drive: int) -> PlaceMap:
    """Places of scans of one of several drives, all called 08."""
    poses = np.tile(np.eye(4), (len(scans), 1, 1))
    poses[:, 0, 3], poses[:, 1, 3] = scans, drive
    index = Index.empty(2)
    index.add(poses[:, :2, 3], ids=[f"08/{scan}" for scan in scans], positions=poses[:, :3, 3])
    return PlaceMap(
        index, np.zeros((len(scans), 2, 2), np.uint8), poses, np.ones((len(scans), 4)), np.full((len(scans), 2), np.nan)
    )


@pytest.mark.parametrize(
    ("here", "own", "mark"),
    [([0], [], "~2"), ([9], [4], "~2"), ([], [3, 8], ""), ([20], [8, 9], "")],
)
def test_places_of_a_drive_are_called_the_same_wherever_it_was_stopped(here, own, mark):
    """`here` are scans of another drive of this name, `own` those of the same drive, in the map before."""
    before, whole = synthetic(here, drive=1).merged(synthetic(own, drive=2)), synthetic(range(10), drive=2)
    drive = dict(zip(whole.index.ids, whole.world_from_place, strict=True))
    expected = before.merged(whole, drive=drive)
    new = [scan for scan in range(10) if scan not in own]
    assert expected.index.ids[len(before) :] == [f"08{mark}/{scan}" for scan in new]
    for stop in range(1, 10):
        resumed = before.merged(synthetic(range(stop), drive=2), drive=drive).merged(whole, drive=drive)
        assert resumed.index.to_bytes() == expected.index.to_bytes()
        np.testing.assert_array_equal(resumed.world_from_place, expected.world_from_place)


@pytest.mark.slow
def test_scans_that_stand_still_are_one_place_and_what_does_not_fit_is_refused(first, places, params, tmp_path):
    recording, poses = first
    assert len(map_recording(recording, params, np.tile(poses[:1], (len(poses), 1, 1))).places) == 1
    assert places.relocate(params, Scan(points=np.zeros((3, 3), np.float32))) == []
    for cloud, words in (
        (np.full((1, 3), 5, np.float32), "08: expected at least one scan that is not empty, found 10 empty ones"),
        (np.zeros((3, 3), np.float32), "scan 000000 of sequence 08: expected points around the sensor"),
    ):
        bad = dataclasses.replace(with_points(recording, lambda path, cloud=cloud: cloud), label_paths=())
        with pytest.raises(ValueError, match=words):
            map_recording(bad, params, poses)
    places.index.save(tmp_path / "index.safetensors")
    with pytest.raises(ValueError, match="expected a map of places, found an index without images"):
        PlaceMap.load(tmp_path / "index.safetensors")
    places.save(tmp_path / "town.safetensors")
    other = dataclasses.replace(places, index=dataclasses.replace(places.index, weights_hash="other"))
    for use in (
        lambda: PlaceMap.load(tmp_path / "town.safetensors", weights_hash="other"),
        lambda: places.merged(other),
        lambda: other.relocate(params, recording.scan(0)),
    ):
        with pytest.raises(ValueError, match="expected descriptors with weights"):
            use()


def small_map(path: Path, *, distance: str = "l2", **change) -> Path:
    """Write a map of three places, without a network, with a right checksum whatever its content."""
    index = Index.empty(4, weights_hash="w", distance=distance)
    index.add(np.eye(3, 4), ids=["a/0", "a/1", "a/2"], positions=POSES[:, :3, 3])
    arrays = {"images": np.zeros((3, 8, 8), np.uint8), "world_from_place": POSES, "mountings": LEVEL}
    path.write_bytes(index.to_bytes(arrays | change))
    return path


POSES = np.tile(np.eye(4), (3, 1, 1))
LEVEL = np.tile([1.73, 0, 0, 1], (3, 1))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"world_from_place": 2 * POSES}, r"expected world_from_place \(n, 4, 4\), with rotations"),
        ({"images": np.zeros((3, 7, 7), np.uint8)}, "expected images of an even number of cells"),
        ({"mountings": np.tile([1000.0, 0, 0, 1], (3, 1))}, "expected the sensor's height above the ground"),
        ({"distance": "cosine"}, "expected descriptors compared by l2, found cosine"),
    ],
)
def test_a_map_of_another_program_is_refused_though_its_checksum_is_right(tmp_path, change, message):
    assert len(PlaceMap.load(small_map(tmp_path / "good.safetensors"))) == 3
    with pytest.raises(ValueError, match=rf"town\.safetensors: {message}"):
        PlaceMap.load(small_map(tmp_path / "town.safetensors", **change))


def test_a_map_keeps_the_deviations_of_a_sensor_that_tilts(tmp_path):
    deviations = np.array([[0.03, 0.25], [0.04, 0.5], [np.nan, np.nan]])
    places = PlaceMap.load(small_map(tmp_path / "hand.safetensors", mounting_deviations=deviations))
    assert places.mounting(0) == Mounting(1.73, (0.0, 0.0, 1.0), 0.03, 0.25) and places.mounting(2) == Mounting(1.73)
    places.save(tmp_path / "again.safetensors")
    np.testing.assert_array_equal(PlaceMap.load(tmp_path / "again.safetensors").mounting_deviations, deviations)
    ground = np.random.default_rng(0).uniform(-10, 10, (800, 3)) * [1, 1, 0] - [0, 0, 1.6]
    tilted = (ground @ Rotation.from_euler("y", 9, degrees=True).as_matrix()).astype(np.float32)
    found = places.query_mounting(tilted)
    assert found.tilt_deg == pytest.approx(9, abs=0.5) and found.height_m == pytest.approx(1.6, abs=0.05)
    fixed = PlaceMap.load(small_map(tmp_path / "car.safetensors"))
    assert not fixed.tilts and fixed.query_mounting(tilted) == fixed.mounting() == Mounting(1.73)
    np.testing.assert_array_equal(np.isnan(fixed.merged(places).mounting_deviations)[:3], True)
