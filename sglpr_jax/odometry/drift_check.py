"""Drift of odometry, estimated from the drive: images some metres apart show how far the odometry is wrong."""

import dataclasses

import numpy as np
from jaxtyping import Float

from sglpr_jax.odometry.drift_model import DriftModel
from sglpr_jax.registration.bev_alignment import BevRegistration
from sglpr_jax.se3 import inverse, transform, yaw_of

STEP_M, STEP_DEG, MOST_FRAMES = 2.5, 15.0, 20
"""Distance and angle by odometry, and number of frames, from which a scan is compared with the last compared one."""
MAX_STEP_M = 8.0
"""Maximum distance of two compared scans by odometry, in metres. Images of farther ones share too little."""
MAX_SECOND, MAX_ALONG_M = 0.6, 0.2
"""Maximum second-peak ratio and standard deviation of the position, in metres, of a comparison that counts."""
WINDOW_M = 30.0
"""Distance over which odometry and images are compared, in metres."""
MIN_WINDOWS = 3
"""Minimum number of windows for an estimate."""
NOISE, NOISE_DEG = 0.015, 0.025
"""Drift of the images themselves, per metre: of lengths, and of angles in degrees."""
UNUSABLE, UNUSABLE_DEG = 0.3, 0.5
"""Drift per metre from which odometry is ignored: of lengths, and of angles in degrees."""


class OdometryCheck:
    """Compares odometry with images, and estimates its drift."""

    def __init__(self):
        self._last: Float[np.ndarray, "4 4"] | None = None
        """Pose by odometry of the last compared scan."""
        self._frames = 0
        """Number of scans since then."""
        self._start_window()
        self._errors: list[tuple[float, float]] = []
        """Errors of length and angle (degrees) per metre, one of each window."""

    def _start_window(self) -> None:
        self._by_odometry, self._by_images, self._length_m = np.eye(4), np.eye(4), 0.0

    def is_due(self, pose: Float[np.ndarray, "4 4"]) -> bool:
        """Whether the next scan, with this pose by odometry, is compared with the last compared one."""
        if self._last is None or self._frames + 1 >= MOST_FRAMES:
            return True
        motion = inverse(self._last) @ pose
        return bool(np.linalg.norm(motion[:3, 3]) >= STEP_M or abs(yaw_of(motion)) >= np.radians(STEP_DEG))

    def restart(self) -> None:
        """Note that the motion since the last scan is unknown."""
        self._last = None

    def skip(self) -> None:
        """Note a scan that is not compared."""
        self._frames += 1

    def add(self, pose: Float[np.ndarray, "4 4"], link: BevRegistration | None) -> None:
        """Add a compared scan: its gravity-aligned pose, and by the images its pose in the last compared one."""
        step = None if self._last is None else inverse(self._last) @ pose
        self._last, self._frames = pose, 0
        is_clear = link is not None and link.second <= MAX_SECOND and link.along_m <= MAX_ALONG_M
        if step is None or link is None or not is_clear or np.linalg.norm(step[:3, 3]) > MAX_STEP_M:
            self._start_window()
            return
        image_step = transform(float(link.x), float(link.y), float(link.yaw))
        self._by_odometry, self._by_images = self._by_odometry @ step, self._by_images @ image_step
        self._length_m += max(float(np.linalg.norm(motion[:3, 3])) for motion in (step, image_step))
        if self._length_m >= WINDOW_M:
            excess_m = np.linalg.norm(self._by_odometry[:2, 3]) - np.linalg.norm(self._by_images[:2, 3])
            angle = np.degrees(float(yaw_of(inverse(self._by_images) @ self._by_odometry)))
            self._errors.append((float(excess_m) / self._length_m, angle / self._length_m))
            self._start_window()

    @property
    def errors(self) -> tuple[float, float]:
        """Root mean square of the errors of length and angle (degrees) per metre. 0 below the errors of images."""
        if len(self._errors) < MIN_WINDOWS:
            return 0.0, 0.0
        length, angle = np.sqrt(np.square(self._errors).mean(axis=0)).tolist()
        return (length if length > NOISE else 0.0), (angle if angle > NOISE_DEG else 0.0)

    @property
    def is_unusable(self) -> bool:
        """Whether the odometry has little to do with the motion of the sensor."""
        length, angle = self.errors
        return length > UNUSABLE or angle > UNUSABLE_DEG

    def drift(self, stated: DriftModel) -> DriftModel:
        """Drift of the odometry: the stated one or, if it is larger, the estimate."""
        length, angle = self.errors
        larger = max(stated.metres_per_metre, length), max(stated.degrees_per_metre, angle)
        return dataclasses.replace(stated, metres_per_metre=larger[0], degrees_per_metre=larger[1])
