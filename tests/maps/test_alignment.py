"""A map of the second visit of a street is aligned with the map of the first one, and another street is not."""

import numpy as np
import pytest
from drives import PASS, SCANS, part_of_drive

from sglpr_jax.maps.alignment import align_maps, without_known_places
from sglpr_jax.maps.build import map_recording
from sglpr_jax.se3 import inverse, transform, yaw_of

WORLD_FROM_OTHER = transform(40.0, -25.0, 2.0)


@pytest.fixture(scope="module")
def second(params):
    """Map of the second visit, in the world frame of the first one."""
    recording = part_of_drive(range(SCANS - 2 * PASS, SCANS, 2), "second")
    return map_recording(recording, params, recording.poses.world_from_lidar).places


@pytest.mark.slow
def test_a_map_in_another_frame_is_moved_to_the_existing_one(places, second):
    found = align_maps(places, second.moved(WORLD_FROM_OTHER))
    assert found is not None and found.places >= 5
    error = WORLD_FROM_OTHER @ found.old_from_new
    assert np.linalg.norm(error[:2, 3]) < 0.3 and abs(np.degrees(yaw_of(error))) < 0.5
    deviations = np.sqrt(np.diag(found.covariance))
    at_street = inverse(second.world_from_place[0]) @ inverse(WORLD_FROM_OTHER) @ inverse(found.old_from_new)
    assert np.isfinite(at_street).all() and (deviations[:2] > 0).all()
    assert f"from {found.places} common places" in str(found)


@pytest.mark.slow
def test_a_map_of_two_days_is_aligned_as_certainly_as_one_of_a_single_day(places, second):
    """The path from the end of a day to the beginning of the next one is no drift."""
    days = [places.subset(range(day, len(places), 2)) for day in range(2)]
    days[1].index.ids[:] = [name.replace("/", "~2/") for name in days[1].index.ids]
    one, two = (align_maps(before, second) for before in (places, days[0].merged(days[1])))
    assert one is not None and two is not None
    assert (np.diag(two.covariance) < 1.2 * np.diag(one.covariance)).all()


@pytest.mark.slow
def test_maps_without_common_places_have_no_transform(places):
    assert align_maps(places, places.subset([])) is None
    assert align_maps(places, places.subset([0, 1])) is None


def test_a_moved_map_has_the_same_places_elsewhere_and_known_places_are_left_out(places, second):
    moved = places.moved(WORLD_FROM_OTHER)
    np.testing.assert_allclose(moved.world_from_place, WORLD_FROM_OTHER @ places.world_from_place)
    np.testing.assert_allclose(moved.index.positions, moved.world_from_place[:, :3, 3], atol=1e-4)
    assert moved.index.ids == places.index.ids
    assert places.subset([2, 0]).index.ids == [places.index.ids[i] for i in (2, 0)]
    assert len(without_known_places(places, moved)) == 0
    assert without_known_places(places, second).index.ids == second.index.ids
