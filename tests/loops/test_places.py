"""A map is kept, merged and asked; scans that it has not seen find themselves."""

import dataclasses

import numpy as np
import pytest
from recordings import with_points

import sglpr_jax
from sglpr_jax.data.record import Record
from sglpr_jax.data.views import rotated
from sglpr_jax.loops.places import PlaceMap
from sglpr_jax.loops.transforms import inverse, yaw_of

MAPPED = 60


@pytest.fixture(scope="module")
def params():
    return sglpr_jax.load("rings")


@pytest.fixture(scope="module")
def first(drive):
    """Every second of the first scans of the drive, and their poses."""
    rows = list(range(0, MAPPED, 2))
    parts = {name: tuple(getattr(drive, name)[i] for i in rows) for name in ("ids", "paths", "label_paths")}
    arrays = {name: getattr(drive, name)[rows] for name in ("positions", "times")}
    return dataclasses.replace(drive, **parts, **arrays), drive.poses.world_from_lidar[rows]


@pytest.fixture(scope="module")
def places(first, params) -> PlaceMap:
    recording, poses = first
    return PlaceMap.of(recording, params, poses)


@pytest.mark.slow
def test_scans_between_those_of_the_map_find_themselves_however_they_are_turned(drive, places, params):
    for frame in (11, 31, 51):
        angle = 2.0 + frame
        found = places.relocate(params, Record(points=rotated(drive.points(frame), angle)))
        true = drive.poses.world_from_lidar[frame]
        error = inverse(true) @ found[0].world_from_query
        assert found[0].probability > 0.99 and np.linalg.norm(error[:2, 3]) < 0.4
        assert abs(np.angle(np.exp(1j * (yaw_of(error) + angle)))) < np.radians(2)
        assert found[0].place == f"08/{drive.ids[frame - 1]}" or found[0].place == f"08/{drive.ids[frame + 1]}"
        assert [one.probability for one in found] == sorted((one.probability for one in found), reverse=True)


@pytest.mark.slow
def test_a_scan_from_elsewhere_is_improbable(drive, places, params):
    apart = np.linalg.norm(drive.positions[:, None] - drive.positions[None, :MAPPED], axis=2).min(axis=1)
    far = int(apart.argmax())
    assert apart[far] > 40
    assert places.relocate(params, drive.record(far))[0].probability < 0.5


@pytest.mark.slow
def test_a_map_comes_back_from_its_file_and_two_are_merged(drive, places, params, tmp_path):
    path = tmp_path / "town.safetensors"
    places.save(path)
    again = PlaceMap.load(path, weights_hash=places.index.weights_hash)
    assert len(again) == len(places) == MAPPED // 2 and again.index.ids == places.index.ids
    np.testing.assert_array_equal(again.images, places.images)
    np.testing.assert_array_equal(again.world_from_place, places.world_from_place)
    both = again.merged(places)
    assert len(both) == MAPPED and both.relocate(params, drive.record(20))[0].probability > 0.99
    whole = path.read_bytes()
    for place in np.linspace(0, len(whole) - 1, 20).astype(int):
        path.write_bytes(whole[:place] + bytes([whole[place] ^ 1]) + whole[place + 1 :])
        with pytest.raises(ValueError, match=r"town\.safetensors: expected an index"):
            PlaceMap.load(path)


@pytest.mark.slow
def test_scans_that_stand_still_are_one_place_and_what_does_not_fit_is_refused(first, places, params, tmp_path):
    recording, poses = first
    assert len(PlaceMap.of(recording, params, np.tile(poses[:1], (len(poses), 1, 1)))) == 1
    with pytest.raises(ValueError, match="expected a pose for each of 30 scans of a recording, found 3"):
        PlaceMap.of(recording, params, poses[:3])
    assert places.relocate(params, Record(points=np.zeros((3, 3), np.float32))) == []
    empty = with_points(recording, lambda path: np.zeros((3, 3), np.float32))
    with pytest.raises(ValueError, match="08: expected scans that show something, found 30 empty ones"):
        PlaceMap.of(dataclasses.replace(empty, label_paths=()), params, poses)
    places.index.save(tmp_path / "index.safetensors")
    with pytest.raises(ValueError, match="expected a map of places, found an index without images"):
        PlaceMap.load(tmp_path / "index.safetensors")
    places.save(tmp_path / "town.safetensors")
    with pytest.raises(ValueError, match="expected descriptors of the weights"):
        PlaceMap.load(tmp_path / "town.safetensors", weights_hash="other")
    other = dataclasses.replace(places, index=dataclasses.replace(places.index, weights_hash="other"))
    with pytest.raises(ValueError, match="expected descriptors of the weights"):
        places.merged(other)
    with pytest.raises(ValueError, match="expected descriptors of the weights"):
        other.relocate(params, recording.record(0))
