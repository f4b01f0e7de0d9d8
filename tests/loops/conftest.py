"""A simulated town that is driven through twice, in opposite directions."""

import numpy as np
import pytest

from sglpr_jax.sim import Sensor, recording
from sglpr_jax.sim.recording import SimulatedRecording

SCANS = 240
SENSOR = Sensor(elevations_deg=tuple(np.linspace(2, -24, 32)), azimuth_steps=600)


@pytest.fixture(scope="session")
def drive() -> SimulatedRecording:
    """240 scans, about 1.8 m apart; it comes back the other way. Each scan is rendered once."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(recording, "KEPT_SCANS", SCANS)
        return recording.simulate_recording("08", scans=SCANS, sensor=SENSOR, seed=3)


@pytest.fixture(scope="session")
def revisit(drive) -> tuple[int, int]:
    """A query and a match within 3 m of each other, half a minute apart or more."""
    apart = np.linalg.norm(drive.positions[:, None] - drive.positions[None], axis=2)
    apart[np.abs(np.subtract.outer(drive.times, drive.times)) < 30] = np.inf
    query, match = np.unravel_index(apart.argmin(), apart.shape)
    assert apart[query, match] < 3
    return int(max(query, match)), int(min(query, match))
