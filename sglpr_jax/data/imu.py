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
"""Duration of the bins whose mean accelerations are smoothed, in seconds."""
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

    def with_times(self, times: Float[np.ndarray, " n"]) -> "Imu":
        """Return the samples with other times, such as those of the recorder, sorted by them."""
        order = np.argsort(times, kind="stable")
        quaternions = None if self.quaternions is None else self.quaternions[order]
        return Imu(times[order], self.rates[order], self.accelerations[order], quaternions)

    def ups(self, times: Float[np.ndarray, " q"]) -> tuple[Float[np.ndarray, "q 3"], str]:
        """Return the direction of up in the frame of the IMU at some times, and a description of its source.

        The orientations are used if they exist and agree with the accelerations. Rows are NaN at times without samples.
        Raises ValueError if there are no orientations and the accelerations do not contain gravity.
        """
        norms = np.linalg.norm(self.accelerations, axis=1)
        norm = float(np.median(norms[np.isfinite(norms)])) if np.isfinite(norms).any() else 0.0
        has_gravity = any(abs(norm / unit - 1) <= SAME_GRAVITY for unit in (STANDARD_GRAVITY, 1.0))
        ups_by_gravity = self._ups_by_gravity(times) if has_gravity else None
        if self.quaternions is not None:
            ups_by_orientation = self._ups_by_orientation(times)
            if ups_by_gravity is None:
                return ups_by_orientation, "its orientation"
            cosines = np.sum(ups_by_orientation * ups_by_gravity, axis=1)
            angles = np.arccos(cosines[np.isfinite(cosines)].clip(-1, 1))
            if not len(angles) or np.degrees(np.median(angles)) <= SAME_UP_DEG:
                return ups_by_orientation, "its orientation"
        if ups_by_gravity is None:
            raise ValueError(f"expected accelerations with gravity, of 9.8 m/s^2 or 1 g, found a median of {norm:.3g}")
        return ups_by_gravity, "its accelerometer and gyroscope"

    def _ups_by_orientation(self, times: Float[np.ndarray, " q"]) -> Float[np.ndarray, "q 3"]:
        """Up by the orientations, interpolated between samples. NaN if no sample is within `GAP_S`."""
        from scipy.spatial.transform import Rotation  # imported here because the import is slow

        sample_ups = Rotation.from_quat(self.quaternions).as_matrix()[:, 2]  # the third row is z of the world
        ups = np.full((len(times), 3), np.nan)
        is_near = np.abs(self.times[nearest_rows(self.times, times)] - times) <= GAP_S
        ups[is_near] = np.stack([np.interp(times[is_near], self.times, axis) for axis in sample_ups.T], axis=1)
        return ups / np.linalg.norm(ups, axis=1, keepdims=True)

    def _ups_by_gravity(self, times: Float[np.ndarray, " q"]) -> Float[np.ndarray, "q 3"]:
        """Up by accelerations and rates, separately for each run of samples without a gap. NaN in the gaps."""
        ups = np.full((len(times), 3), np.nan)
        is_valid = np.isfinite(self.accelerations).all(axis=1) & np.isfinite(self.rates).all(axis=1)
        samples = np.flatnonzero(is_valid & (np.diff(self.times, prepend=-np.inf) > 0))
        for run in np.split(samples, np.flatnonzero(np.diff(self.times[samples]) > GAP_S) + 1):
            if len(run) < 2:
                continue
            stamps = self.times[run]
            in_run = (times >= stamps[0] - GAP_S) & (times <= stamps[-1] + GAP_S)
            ups[in_run] = _ups_by_averaging(stamps, self.rates[run], self.accelerations[run], times=times[in_run])
        return ups


def _ups_by_averaging(
    stamps: Float[np.ndarray, " n"],
    rates: Float[np.ndarray, "n 3"],
    accelerations: Float[np.ndarray, "n 3"],
    *,
    times: Float[np.ndarray, " q"],
) -> Float[np.ndarray, "q 3"]:
    """Up at `times`, from samples at `stamps` with angular velocities `rates` (rad/s). Both times are in seconds.

    Accelerations are averaged in a frame that does not turn: that of the first sample. A line is fitted to those of
    `AVERAGED_S`, so that a constant bias of the gyroscope cancels.
    """
    from scipy.signal import savgol_filter  # imported here because the imports are slow
    from scipy.spatial.transform import Rotation

    rotation_steps = Rotation.from_rotvec((rates[1:] + rates[:-1]) / 2 * np.diff(stamps)[:, None]).as_matrix()
    start_from_imu = np.array([*itertools.accumulate(rotation_steps, initial=np.eye(3), func=np.matmul)])
    accelerations_in_start = np.einsum("nij,nj->ni", start_from_imu, accelerations)
    bin_numbers = ((stamps - stamps[0]) / BIN_S).astype(np.int64)
    _, bin_of_sample, counts = np.unique(bin_numbers, return_inverse=True, return_counts=True)
    bin_means = np.stack([np.bincount(bin_of_sample, axis) / counts for axis in accelerations_in_start.T], axis=1)
    bin_times = np.bincount(bin_of_sample, stamps) / counts
    window = min(round(AVERAGED_S / BIN_S), len(bin_means) - 1) // 2 * 2 + 1  # the filter needs an odd number of bins
    smooth = np.asarray(savgol_filter(bin_means, window, min(1, window - 1), axis=0))
    gravity_in_start = np.stack([np.interp(times, bin_times, axis) for axis in smooth.T], axis=1)
    sample = nearest_rows(stamps, times)
    imu_from_time = Rotation.from_rotvec(rates[sample] * (times - stamps[sample])[:, None]).as_matrix()
    ups = np.einsum("nji,nj->ni", start_from_imu[sample] @ imu_from_time, gravity_in_start)
    return ups / np.linalg.norm(ups, axis=1, keepdims=True)
