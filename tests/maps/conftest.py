"""A simulated street that is driven twice, and a map of the first time."""

import numpy as np
import pytest
from drives import PASS, drive, params, part_of_drive  # noqa: F401

from sglpr_jax.maps.build import map_recording
from sglpr_jax.maps.place_map import PlaceMap
from sglpr_jax.sim.recording import SimulatedRecording


@pytest.fixture(scope="session")
def first() -> tuple[SimulatedRecording, np.ndarray]:
    """Every second scan of the street, 7 m apart, and their poses."""
    recording = part_of_drive(range(0, 2 * PASS, 4))
    return recording, recording.poses.world_from_lidar


@pytest.fixture(scope="session")
def places(first, params) -> PlaceMap:  # noqa: F811
    """The map of these."""
    return map_recording(first[0], params, first[1]).places
