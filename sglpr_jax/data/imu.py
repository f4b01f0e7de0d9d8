"""Direction of up from an IMU: its orientation, or its accelerometer averaged over time with its gyroscope.

An accelerometer measures gravity and the motion of the sensor. The gyroscope measures how the sensor turns, so that
accelerations can be rotated into one frame. Their average over some seconds is gravity.
"""

import itertools
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from sglpr_jax.data.times import nearest_rows

AVERAGED_S = 20.0
"""Duration over which accelerations are averaged, in seconds."""
BIN_S = 0.1
"""Duration over which accelerations are averaged before they are smoothed, in seconds."""
GAP_S = 0.2
"""Maximum time between two samples, in seconds. A longer one interrupts the integral of the gyroscope."""
STANDARD_GRAVITY = 9.80665
"""Acceleration of gravity, in m/s^2."""
SAME_GRAVITY = 0.1
"""Maximum deviation of the mean acceleration from gravity, as a share of it."""
SAME_UP_DEG = 20.0
"""Maximum median angle between up by the orientation and up by the accelerometer. Beyond it, the orientation belongs to
another convention of axes."""


@dataclass(frozen=True, eq=False)
class Imu:
    """Samples of an IMU in its own frame, in the order of time."""

    times: Float[np.ndarray, " n"]
    """Times in seconds."""
    rates: Float[np.ndarray, "n 3"]
    """Angular velocities, in radians per second."""
    accelerations: Float[np.ndarray, "n 3"]
    """Accelerations with gravity, in m/s^2 or in multiples of gravity. At rest they point up."""
    quaternions: Float[np.ndarray, "n 4"] | None = None
    """Orientations in a frame with z up as x, y, z, w, or None if the IMU does not estimate them."""

    def at(self, times: Float[np.ndarray, " n"]) -> "Imu":
        """Return the samples in order of other times, such as those of the recorder."""
        order = np.argsort(times, kind="stable")
        quaternions = None if self.quaternions is None else self.quaternions[order]
        return Imu(times[order], self.rates[order], self.accelerations[order], quaternions)

    def ups(self, times: Float[np.ndarray, " q"]) -> tuple[Float[np.ndarray, "q 3"], str]:
        """Return the direction of up in the frame of the IMU at some times, and a description of its source.

        Rows are NaN at times without samples. Raises ValueError without gravity and without orientations.
        """
        norms = np.linalg.norm(self.accelerations, axis=1)
        size = float(np.median(norms[np.isfinite(norms)])) if np.isfinite(norms).any() else 0.0
        with_gravity = any(abs(size / unit - 1) <= SAME_GRAVITY for unit in (STANDARD_GRAVITY, 1.0))
        by_gravity = self._ups_by_gravity(times) if with_gravity else None
        if self.quaternions is not None:
            by_orientation = self._ups_by_orientation(times)
            cosines = np.ones(1) if by_gravity is None else np.sum(by_orientation * by_gravity, axis=1)
            angles = np.arccos(cosines[np.isfinite(cosines)].clip(-1, 1))
            if not len(angles) or np.degrees(np.median(angles)) <= SAME_UP_DEG:
                return by_orientation, "its orientation"
        if by_gravity is None:
            raise ValueError(f"expected accelerations with gravity, of 9.8 m/s^2 or 1 g, found a median of {size:.3g}")
        return by_gravity, "its accelerometer and gyroscope"

    def _ups_by_orientation(self, times: Float[np.ndarray, " q"]) -> Float[np.ndarray, "q 3"]:
        from scipy.spatial.transform import Rotation  # imported here because the import is slow

        measured = Rotation.from_quat(self.quaternions).as_matrix()[:, 2]
        ups = np.full((len(times), 3), np.nan)
        near = np.abs(self.times[nearest_rows(self.times, times)] - times) <= GAP_S
        ups[near] = np.stack([np.interp(times[near], self.times, axis) for axis in measured.T], axis=1)
        return ups / np.linalg.norm(ups, axis=1, keepdims=True)

    def _ups_by_gravity(self, times: Float[np.ndarray, " q"]) -> Float[np.ndarray, "q 3"]:
        """Up by the accelerometer, for each part between two gaps."""
        ups = np.full((len(times), 3), np.nan)
        valid = np.isfinite(self.accelerations).all(axis=1) & np.isfinite(self.rates).all(axis=1)
        samples = np.flatnonzero(valid & (np.diff(self.times, prepend=-np.inf) > 0))
        for part in np.split(samples, np.flatnonzero(np.diff(self.times[samples]) > GAP_S) + 1):
            if len(part) < 2:
                continue
            stamps = self.times[part]
            within = (times >= stamps[0] - GAP_S) & (times <= stamps[-1] + GAP_S)
            ups[within] = _averaged_up(stamps, self.rates[part], self.accelerations[part], times=times[within])
        return ups


def _averaged_up(
    stamps: Float[np.ndarray, " n"],
    rates: Float[np.ndarray, "n 3"],
    accelerations: Float[np.ndarray, "n 3"],
    *,
    times: Float[np.ndarray, " q"],
) -> Float[np.ndarray, "q 3"]:
    """Up at some times by accelerations that are averaged in a frame that does not turn.

    A line is fitted to `AVERAGED_S` of accelerations, so that a constant bias of the gyroscope cancels.
    """
    from scipy.signal import savgol_filter  # imported here because the imports are slow
    from scipy.spatial.transform import Rotation

    turns = (rates[1:] + rates[:-1]) / 2 * np.diff(stamps)[:, None]
    start_from_imu = np.array(
        [*itertools.accumulate(Rotation.from_rotvec(turns).as_matrix(), initial=np.eye(3), func=np.matmul)]
    )
    in_start = np.einsum("nij,nj->ni", start_from_imu, accelerations)
    bins = ((stamps - stamps[0]) / BIN_S).astype(np.int64)
    _, bin_of, counts = np.unique(bins, return_inverse=True, return_counts=True)
    means = np.stack([np.bincount(bin_of, axis) / counts for axis in in_start.T], axis=1)
    mean_times = np.bincount(bin_of, stamps) / counts
    width = min(round(AVERAGED_S / BIN_S), len(means) - 1) // 2 * 2 + 1
    smooth = np.asarray(savgol_filter(means, width, min(1, width - 1), axis=0))
    gravity = np.stack([np.interp(times, mean_times, axis) for axis in smooth.T], axis=1)
    sample = nearest_rows(stamps, times)
    since = Rotation.from_rotvec(rates[sample] * (times - stamps[sample])[:, None]).as_matrix()
    ups = np.einsum("nji,nj->ni", start_from_imu[sample] @ since, gravity)
    return ups / np.linalg.norm(ups, axis=1, keepdims=True)
