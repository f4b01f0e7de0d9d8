"""A map of the second visit of a street is aligned with the map of the first one, and another street is not."""

import dataclasses

import numpy as np
import pytest

import sglpr_jax
from sglpr_jax.data.scan_stream import only
from sglpr_jax.maps.alignment import align_maps, check_one_frame, without_known_places
from sglpr_jax.maps.build import map_recording
from sglpr_jax.maps.place_map import PlaceMap
from sglpr_jax.se3 import inverse, transform, yaw_of

SCANS = 26
WORLD_FROM_OTHER = transform(40.0, -25.0, 2.0)


@pytest.fixture(scope="module")
def maps(drive, revisit):
    """Maps of the two visits of a street, in one world frame."""
    params = sglpr_jax.load("sglpr")

    def map_around(frame: int, name: str) -> PlaceMap:
        rows = list(range(max(frame - SCANS // 2, 0), min(frame + SCANS // 2, len(drive))))
        recording = dataclasses.replace(only(drive, rows), name=name)
        return map_recording(recording, params, drive.poses.world_from_lidar[rows], spacing_m=0.0).places

    query, match = revisit
    return map_around(match, "first"), map_around(query, "second")


@pytest.mark.slow
def test_a_map_in_another_frame_is_moved_to_the_existing_one(maps):
    first, second = maps
    found = align_maps(first, second.moved(WORLD_FROM_OTHER))
    assert found is not None and found.places >= 5
    error = WORLD_FROM_OTHER @ found.old_from_new
    assert np.linalg.norm(error[:2, 3]) < 0.3 and abs(np.degrees(yaw_of(error))) < 0.5
    deviations = np.sqrt(np.diag(found.covariance))
    at_street = inverse(second.world_from_place[0]) @ inverse(WORLD_FROM_OTHER) @ inverse(found.old_from_new)
    assert np.isfinite(at_street).all() and (deviations[:2] > 0).all()
    assert f"from {found.places} common places" in str(found)


@pytest.mark.slow
def test_common_places_elsewhere_contradict_one_frame(maps):
    first, second = maps
    check_one_frame(first, second)
    with pytest.raises(ValueError, match=r"found \d+ places that are .* m away .*--frame align"):
        check_one_frame(first, second.moved(transform(30.0, 0.0, 0.0)))


@pytest.mark.slow
def test_maps_without_common_places_have_no_transform(maps):
    first = maps[0]
    assert align_maps(first, first.some([])) is None
    assert align_maps(first, first.some([0, 1])) is None


def test_known_places_are_left_out(maps):
    first, second = maps
    assert len(without_known_places(first, first.moved(WORLD_FROM_OTHER))) == 0
    assert without_known_places(first, second).index.ids == second.index.ids


def test_a_moved_map_has_the_same_places_elsewhere(maps):
    first = maps[0]
    moved = first.moved(WORLD_FROM_OTHER)
    np.testing.assert_allclose(moved.world_from_place, WORLD_FROM_OTHER @ first.world_from_place)
    np.testing.assert_allclose(moved.index.positions, moved.world_from_place[:, :3, 3], atol=1e-4)
    assert moved.index.ids == first.index.ids and first.some([2, 0]).index.ids == [first.index.ids[i] for i in (2, 0)]
