"""Drift of odometry, estimated during a drive from the registration of images some metres apart."""

import dataclasses

import numpy as np
from jaxtyping import Float

from sglpr_jax.odometry.drift_model import DriftModel
from sglpr_jax.registration.bev_alignment import BevRegistration
from sglpr_jax.se3 import inverse, yaw_of

STEP_M, STEP_DEG = 2.5, 15.0
"""Minimum distance (metres) or angle (degrees) by odometry between two compared scans."""
MAX_STEP_M = 8.0
"""Maximum distance of two compared scans by odometry, in metres. Images of farther ones share too little."""
MAX_SECOND, MAX_ALONG_M = 0.6, 0.2
"""Maximum second-peak ratio and standard deviation of the position, in metres, of a registration that counts."""
WINDOW_M = 30.0
"""Length of a window, a part of the drive over which odometry and images are compared, in metres."""
MIN_WINDOWS = 3
"""Minimum number of windows for an estimate."""
NOISE, NOISE_DEG = 0.015, 0.025
"""Drift of the motion by images itself, per metre: in length, and in degrees."""
UNUSABLE, UNUSABLE_DEG = 0.3, 0.5
"""Drift per metre above which odometry is ignored: in length, and in degrees."""


class OdometryCheck:
    """Compares odometry with the registration of images, and estimates its drift."""

    def __init__(self):
        self._last_pose: Float[np.ndarray, "4 4"] | None = None
        """Pose by odometry of the last scan that was registered for this check. None if the motion since is unknown."""
        self._start_window()
        self._errors: list[tuple[float, float]] = []
        """For each window, the motion by odometry minus that by images: length, and angle in degrees, per metre."""

    def _start_window(self) -> None:
        """Forget the motion by odometry and by images since the start of the window."""
        self._by_odometry, self._by_images, self._length_m = np.eye(4), np.eye(4), 0.0

    def is_due(self, pose: Float[np.ndarray, "4 4"]) -> bool:
        """Whether the next scan, with this pose by odometry, should be compared with the last compared one."""
        if self._last_pose is None:
            return True
        motion = inverse(self._last_pose) @ pose
        return bool(np.linalg.norm(motion[:3, 3]) >= STEP_M or abs(yaw_of(motion)) >= np.radians(STEP_DEG))

    def restart(self) -> None:
        """Note that the motion since the last scan is unknown."""
        self._last_pose = None

    def add(self, pose: Float[np.ndarray, "4 4"], link: BevRegistration | None) -> None:
        """Add a compared scan: its gravity-aligned pose by odometry, and its registration with the last compared one.

        If the registration does not count, a new window starts.
        """
        step = None if self._last_pose is None else inverse(self._last_pose) @ pose
        self._last_pose = pose
        is_clear = link is not None and link.peak_ratio <= MAX_SECOND and link.along_m <= MAX_ALONG_M
        if step is None or link is None or not is_clear or np.linalg.norm(step[:3, 3]) > MAX_STEP_M:
            self._start_window()
            return
        image_step = link.match_from_query
        self._by_odometry, self._by_images = self._by_odometry @ step, self._by_images @ image_step
        self._length_m += max(float(np.linalg.norm(motion[:3, 3])) for motion in (step, image_step))
        if self._length_m >= WINDOW_M:
            error_m = np.linalg.norm(self._by_odometry[:2, 3]) - np.linalg.norm(self._by_images[:2, 3])
            error_deg = np.degrees(float(yaw_of(inverse(self._by_images) @ self._by_odometry)))
            self._errors.append((float(error_m) / self._length_m, error_deg / self._length_m))
            self._start_window()

    @property
    def errors(self) -> tuple[float, float]:
        """Root mean square errors of length and angle (degrees) per metre of all windows.

        An error that does not exceed the noise of the registration counts as 0, and so do those of few windows.
        """
        if len(self._errors) < MIN_WINDOWS:
            return 0.0, 0.0
        length, degrees = np.sqrt(np.square(self._errors).mean(axis=0)).tolist()
        return (length if length > NOISE else 0.0), (degrees if degrees > NOISE_DEG else 0.0)

    @property
    def is_unusable(self) -> bool:
        """Whether the odometry is too wrong to be used."""
        length, degrees = self.errors
        return length > UNUSABLE or degrees > UNUSABLE_DEG

    def drift(self, stated: DriftModel) -> DriftModel:
        """The stated drift, increased to the estimates in length and in heading where these are larger."""
        length, degrees = self.errors
        metres_per_metre = max(stated.metres_per_metre, length)
        degrees_per_metre = max(stated.degrees_per_metre, degrees)
        return dataclasses.replace(stated, metres_per_metre=metres_per_metre, degrees_per_metre=degrees_per_metre)
