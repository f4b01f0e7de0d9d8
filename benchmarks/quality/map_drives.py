"""Simulated drives for `cloud_map.py`: a town driven by a mapping sensor, and on another day by others."""

import dataclasses
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Float32
from scipy.spatial.transform import Rotation

import sglpr_jax
from sglpr_jax.data.mounting import Mounting
from sglpr_jax.data.recording import Recording
from sglpr_jax.files import replacing
from sglpr_jax.sim.sensor import SENSORS
from sglpr_jax.sim.sessions import plan_sessions

DAYS = ("2012-01-15", "2012-02-04")
ROUTES = ("00", "05", "08")
NOISE_M, NOISE_DEG = 0.05, 0.1
"""Standard deviation of a registered front end's poses, in metres and degrees along and about each axis."""
DRIVE_S = 60.0
"""Duration of a drive, in seconds."""


class Drive(NamedTuple):
    """Scans of one sensor in a folder, and their true poses."""

    folder: Path
    world_from_lidar: Float[np.ndarray, "n 4 4"]
    sensor: str

    def points(self, row: int) -> Float32[np.ndarray, "n 3"]:
        """Points of a scan."""
        return np.fromfile(self.folder / f"{row:06d}.bin", "<f4").reshape(-1, 4)[:, :3]

    def recording(self) -> Recording:
        """The recording of the folder, with the sensor's height."""
        return sglpr_jax.open_recording(self.folder, format="kitti", sensor_height=SENSORS[self.sensor].height_m)

    @property
    def mounting(self) -> Mounting:
        """Height of the sensor above the road."""
        return Mounting(SENSORS[self.sensor].height_m)


def driven(root: Path, *, seed: int, sensor: str, day: int, scans: int, azimuth_steps: int) -> Drive:
    """Return a drive. Its scans are rendered unless they exist."""
    folder = root / f"{seed}-{sensor}-day{day}-{scans}x{azimuth_steps}"
    poses_file = folder / "poses.npy"
    if not poses_file.exists():
        folder.mkdir(parents=True, exist_ok=True)
        lidar = dataclasses.replace(SENSORS[sensor], azimuth_steps=azimuth_steps)
        options = {"scans": scans, "rate_hz": scans / DRIVE_S, "seed": seed}
        session = plan_sessions(DAYS, route=ROUTES[seed % len(ROUTES)], sensor=lidar, **options)[day]
        recording = session.simulate()
        for row in range(len(recording)):
            points = recording.points(row)
            rows = np.concatenate([points, np.ones((len(points), 1), np.float32)], axis=1)
            rows.astype("<f4").tofile(folder / f"{row:06d}.bin")
        with replacing(poses_file) as temporary, temporary.open("wb") as file:
            np.save(file, recording.poses.world_from_lidar)
    return Drive(folder, np.load(poses_file), sensor)


def noisy(poses: Float[np.ndarray, "n 4 4"], *, seed: int) -> Float[np.ndarray, "n 4 4"]:
    """Poses with independent errors of `NOISE_M` and `NOISE_DEG`."""
    rng = np.random.default_rng((seed, 39))
    found = poses.copy()
    turned = Rotation.from_rotvec(np.radians(rng.normal(0, NOISE_DEG, (len(poses), 3)))).as_matrix()
    found[:, :3, :3] = poses[:, :3, :3] @ turned
    found[:, :3, 3] += rng.normal(0, NOISE_M, (len(poses), 3))
    return found
