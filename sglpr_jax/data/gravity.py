"""Mounting of a recording's sensor: given by the user, or estimated from the ground, once or at each scan.

The ground of a scan gives the height of the sensor and the direction of up. `GroundFilter` smooths both over scans.
`with_odometry` averages up over some metres of path.
"""

import dataclasses
import os
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from sglpr_jax.data.choices import Gravity, SensorHeight
from sglpr_jax.data.mounting import MODEL_HEIGHT_M, Mounting, common_mounting, estimate_mounting, upright_from_lidar
from sglpr_jax.data.recording import Recording
from sglpr_jax.data.scan import Scan
from sglpr_jax.data.scan_stream import sampled_points, scan_stream
from sglpr_jax.fields import check_value, require
from sglpr_jax.files import warn
from sglpr_jax.se3 import inverse, travelled

SCANS, SCANS_CHECKED = 11, 3
"""Number of scans, spread over the recording, for estimating the mounting and for checking that of a layout."""
SAME_HEIGHT_M, LARGEST_TILT_DEG = 0.4, 10.0
"""Maximum height difference, in metres, and maximum tilt, in degrees, of a sensor that fits its layout."""
FIXED_DEG = 3.0
"""Maximum angle of a fixed sensor between up of a scan and of the median, in degrees. The 90 % quantile is compared."""
GROUND_TILT_DEG, GROUND_HEIGHT_M = 0.25, 0.03
"""Standard deviations of up about each horizontal axis, and of the height, from the ground of one scan."""
SPREAD_DEG, SPREAD_M = 8.0, 0.15
"""Standard deviations of tilt and height of a handheld sensor, for a stream whose scans are not known in advance."""
LEAST_SPREAD_DEG, LEAST_SPREAD_M = 2.0, 0.05
"""Minimum of these standard deviations if they are estimated from the scans of a recording."""
IMU_TILT_DEG, SLOPE_DEG = 1.0, 1.0
"""Standard deviations of up about each horizontal axis by an IMU, and of the slope of the ground."""
IMU_APART_DEG = 10.0
"""Maximum median angle between up by an IMU and by the ground. Beyond it, the axes of the IMU are wrong."""
LEAST_SHARE = 0.5
"""Minimum share of scans with samples of the IMU."""
MEMORY = 0.8
"""Share of the deviation from the mean that remains until the next scan. A handheld sensor turns within a second."""
GATE = 4.6
"""Maximum Mahalanobis distance between the ground of a scan and its prediction, with 3 degrees of freedom."""
AVERAGED_M = 8.0
"""Standard deviation of the Gaussian over which up is averaged along the path, in metres."""
ODOMETRY_TILT_DEG = 0.3
"""Standard deviation of up about each horizontal axis, averaged with odometry."""
MOST_UNEXPLAINED = 0.5
"""Maximum angle between up by the ground and up by the odometry, as a share of the tilt, if the odometry shows tilt."""
LEAST_PATH_M = 20.0
"""Minimum path length for the check of poses, in metres."""
STEEPEST = 0.7
"""Maximum share of a vehicle's path that goes up or down: the sine of 45 degrees."""


def mounted(recording: Recording, height: SensorHeight, *, gravity: Gravity = "auto", known: bool) -> Recording:
    """Return the recording with its sensor mounting, and a note about it in `Recording.found`.

    If the ground does not show the mounting, it stays unknown, and models assume a sensor 1.73 m above the ground.

    Arguments:
      recording: Recording of scans. A recording of images is returned unchanged.
      height: Height above the ground in metres, "estimate" or "auto". "auto" estimates the mounting only if the layout
        does not define it.
      gravity: "recording" uses one mounting for all scans, "scan" estimates height and up of each scan. "auto" does so
        if the mounting is estimated and the sensor tilts by more than `FIXED_DEG`.
      known: Whether the layout defines the mounting. If the scans contradict it, height "auto" issues a `DataWarning`.
    """
    if recording.has_images:
        return recording
    check_value(gravity, Gravity, "gravity")
    if height == "auto" and known:
        _check_layout(recording)
    elif height in ("auto", "estimate"):
        return _with_estimated_mounting(recording, gravity)
    else:
        require(height, not isinstance(height, str), "metres above the ground, 'auto' or 'estimate'", "sensor_height")
        mounting = Mounting(float(height))
        recording = recording.with_note(f"sensor: {mounting}, as given", mounting=mounting)
    return with_gravity(recording, recording.mounting or Mounting(MODEL_HEIGHT_M)) if gravity == "scan" else recording


def _with_estimated_mounting(recording: Recording, gravity: Gravity) -> Recording:
    """Return the recording with the common mounting of some of its scans, or one per scan as in `mounted`."""
    estimates = _estimated_mountings(recording, SCANS)
    valid = [mounting for mounting in estimates if mounting is not None]
    common = common_mounting(estimates)
    upside_down = sum(mounting.up[2] < 0 for mounting in valid)
    upright = len(valid) - upside_down
    if common is not None:
        agreeing = upside_down if common.up[2] < 0 else upright
        note = f"sensor: {common}, estimated from the ground in {agreeing} of {len(estimates)} scans"
    else:
        problem = f"ground found in {len(valid)} of {len(estimates)} scans (is z up in these files?)"
        if 2 * len(valid) >= len(estimates):
            problem = (
                f"the ground is below the sensor in {upright} of {len(estimates)} scans and above it in {upside_down}"
            )
        note = f"sensor: {problem}, assumed {MODEL_HEIGHT_M} m above the ground; set --sensor-height"
    recording = recording.with_note(note, mounting=common)
    mean = common or Mounting(MODEL_HEIGHT_M)
    ups = np.array([mounting.up for mounting in valid if np.dot(mounting.up, mean.up) > 0])
    tilts = common is not None and len(ups) > 0 and _spread_deg(ups, np.array(mean.up)) > FIXED_DEG
    return with_gravity(recording, mean) if gravity == "scan" or (gravity == "auto" and tilts) else recording


def _check_layout(recording: Recording) -> None:
    """Issue a `DataWarning` if the scans contradict the mounting of the layout, e.g. of another sensor than KITTI's."""
    expected = recording.mounting or Mounting(MODEL_HEIGHT_M)
    mounting = common_mounting(_estimated_mountings(recording, SCANS_CHECKED))
    if mounting is None:
        return
    if abs(mounting.height_m - expected.height_m) > SAME_HEIGHT_M or mounting.tilt_deg > LARGEST_TILT_DEG:
        warn(
            f"sequence {recording.name}: expected the sensor {expected}, as its layout defines, found it {mounting};"
            " for another sensor pass --sensor-height estimate, or its height in metres"
        )


def _estimated_mountings(recording: Recording, scans: int) -> list[Mounting | None]:
    """Mounting at some scans, spread over the recording. None for a scan that is unreadable or shows no ground."""
    clouds = sampled_points(recording, scans)
    return [None if points is None else estimate_mounting(points) for points in clouds]


class GroundFilter:
    """Kalman filter of the height of a sensor and the direction of up over consecutive scans.

    The prediction is the last state, drawn towards the mean. Ground that contradicts the prediction is ignored.

    Example:
      gravity = sglpr_jax.GroundFilter(sglpr_jax.estimate_mounting(first_points))
      scan = sglpr_jax.Scan(points=points, mounting=gravity.add(points))
    """

    def __init__(self, mean: Mounting, *, spread_deg: float = SPREAD_DEG, spread_m: float = SPREAD_M):
        """Start at the mean mounting, with standard deviations of up about each horizontal axis and of the height."""
        self.mean = mean
        self.ground_used = 0
        """Number of scans whose ground was used."""
        self._spread = _variances(spread_deg, spread_m)
        self._noise = _variances(GROUND_TILT_DEG, GROUND_HEIGHT_M)
        self._state = np.zeros(3)  # deviation from the mean, as of `_deviation`
        self._variance = self._spread

    def add(self, points: Float[np.ndarray, "n 3"]) -> Mounting:
        """Estimate the mounting at the next scan from its points (n, 3), in metres."""
        return self.update(estimate_mounting(points, near=self.mean))

    def update(self, ground: Mounting | None, *, up: Float[np.ndarray, "3"] | None = None) -> Mounting:
        """Add the mounting by the ground of the next scan, or None for a scan without ground. Returns the estimate.

        `up` is the direction of up in the LiDAR frame by an IMU, which replaces that of the mean at this scan.
        """
        mean, spread, noise = self.mean, self._spread, self._noise
        if up is not None:
            mean = dataclasses.replace(mean, up=tuple(up.tolist()))
            spread = np.array([np.radians(IMU_TILT_DEG) ** 2] * 2 + [spread[2]])
            noise = np.array([np.radians(SLOPE_DEG) ** 2] * 2 + [noise[2]])
        state = MEMORY * self._state
        variance = MEMORY**2 * self._variance + (1 - MEMORY**2) * spread
        if ground is not None:
            innovation = _deviation(ground, mean) - state
            if np.sum(innovation**2 / (variance + noise)) <= GATE**2:
                self.ground_used += 1
                gain = variance / (variance + noise)
                state, variance = state + gain * innovation, variance * (1 - gain)
        self._state, self._variance = state, variance
        tilt_deviation_deg = float(np.degrees(np.sqrt(variance[:2].mean())))
        return _mounting_at(mean, state, float(np.sqrt(variance[2])), tilt_deviation_deg)


def with_gravity(recording: Recording, common: Mounting) -> Recording:
    """Return the recording with a mounting for each scan, near a `common` mounting. This reads all scans."""

    def ground_of(row: int, scan: Scan) -> Mounting | None:
        return estimate_mounting(scan.cloud, near=common)

    options = {"ahead": os.cpu_count() or 1, "on_bad_scan": lambda scan, error: None}
    estimates = [mounting for _, mounting in scan_stream(recording, ground_of, **options)]
    valid = [mounting for mounting in estimates if mounting is not None] or [common]
    deviations = np.array([_deviation(mounting, common) for mounting in valid])
    median = np.median(deviations, axis=0)
    mean = _mounting_at(common, median, 0.0, 0.0)
    spread = 1.4826 * np.median(np.abs(deviations - median), axis=0)  # a robust standard deviation
    ground_filter = GroundFilter(
        mean,
        spread_deg=max(float(np.degrees(spread[:2].max())), LEAST_SPREAD_DEG),
        spread_m=max(float(spread[2]), LEAST_SPREAD_M),
    )
    ups, imu_note = _ups_by_imu(recording, estimates)
    mountings = tuple(ground_filter.update(mounting, up=up) for mounting, up in zip(estimates, ups, strict=True))
    spread_deg = _spread_deg(np.array([mounting.up for mounting in valid]), np.array(mean.up))
    note = (
        f"gravity: the sensor tilts by {spread_deg:.0f} degrees about its mean; height and tilt of each scan from the "
        f"ground in {ground_filter.ground_used} of {len(estimates)} scans{imu_note}"
    )
    return recording.with_note(note, mountings=mountings, read_ups=None)


def _ups_by_imu(
    recording: Recording, by_ground: Sequence[Mounting | None]
) -> tuple[list[Float[np.ndarray, "3"] | None], str]:
    """Direction of up at each scan by the IMU, or None without samples, and a text about the IMU for a note.

    An IMU that contradicts the mountings by the ground, or has few samples, is not used for any scan.
    """
    unused: list[Float[np.ndarray, 3] | None] = [None] * len(recording)
    imu = None if recording.read_ups is None else recording.read_ups()
    if imu is None:
        return unused, ""
    measured, source = imu  # up at each scan, NaN without samples; description of the IMU
    ups = [up if np.isfinite(up).all() else None for up in measured]
    share = np.mean([up is not None for up in ups])
    if share < LEAST_SHARE:
        return unused, f"; {source}, has samples at only {share:.0%} of the scans and is not used"
    pairs = [(up, mounting.up) for up, mounting in zip(ups, by_ground, strict=True) if up is not None and mounting]
    angle_deg = np.median(_angles_deg(*np.array(pairs).swapaxes(0, 1))) if pairs else 0.0
    if angle_deg > IMU_APART_DEG:
        return unused, f"; {source}, is {angle_deg:.0f} degrees apart from the ground and is not used"
    return ups, f" and from {source}"


def with_odometry(recording: Recording, world_from_lidar: Float[np.ndarray, "n 4 4"]) -> Recording:
    """Return the recording with up of each scan averaged along the path, if the recording has `mountings`.

    Odometry that does not show the tilt, as that of wheels, is not used. Issues a `DataWarning` if the path goes mostly
    up or down, as with poses in camera axes (z forward).
    """
    _check_climb(recording, world_from_lidar)
    if recording.mountings is None:
        return recording
    rotations = world_from_lidar[:, :3, :3]
    ups = np.array([mounting.up for mounting in recording.mountings])
    world_ups = np.einsum("nij,nj->ni", rotations, ups)
    deviations_deg = [mounting.tilt_deviation_deg or GROUND_TILT_DEG for mounting in recording.mountings]
    mean_world_ups = _averaged_along_path(world_ups, 1 / np.array(deviations_deg) ** 2, travelled(world_from_lidar))
    median = np.median(ups, axis=0)
    angle_deg = _spread_deg(world_ups, mean_world_ups)
    if angle_deg > MOST_UNEXPLAINED * _spread_deg(ups, median / np.linalg.norm(median)):
        return recording.with_note("gravity: the odometry does not show the tilt of the scans; their ground is used")
    mean_ups = np.einsum("nji,nj->ni", rotations, mean_world_ups).tolist()
    mountings = tuple(
        dataclasses.replace(mounting, up=tuple(up), tilt_deviation_deg=ODOMETRY_TILT_DEG)
        for mounting, up in zip(recording.mountings, mean_ups, strict=True)
    )
    note = f"gravity: tilt of each scan from the odometry and the ground, {angle_deg:.1f} degrees apart"
    return recording.with_note(note, mountings=mountings)


def _check_climb(recording: Recording, world_from_lidar: Float[np.ndarray, "n 4 4"]) -> None:
    """Issue a `DataWarning` if more than `STEEPEST` of the path goes up or down."""
    steps = (inverse(world_from_lidar[:-1]) @ world_from_lidar[1:])[:, :3, 3]  # in the frame of the earlier scan
    path_m = float(np.linalg.norm(steps, axis=1).sum())
    ups = recording.uprights[:-1, 2, :3]
    climbed_m = float(np.abs((steps * ups).sum(axis=1)).sum())
    if path_m > LEAST_PATH_M and climbed_m > STEEPEST * path_m:
        warn(
            f"{recording.name}: expected poses of a LiDAR that moves along the ground (x forward, y left, z up), found "
            f"{climbed_m:.0f} of {path_m:.0f} m of path up or down; are they in camera axes (kitti)?"
        )


def _variances(tilt_deg: float, height_m: float) -> Float[np.ndarray, "3"]:
    """Variances of up about each horizontal axis (radians) and of the height (metres)."""
    return np.array([np.radians(tilt_deg)] * 2 + [height_m]) ** 2


def _deviation(mounting: Mounting, mean: Mounting) -> Float[np.ndarray, "3"]:
    """x and y of up of a mounting in the gravity-aligned frame of the mean, and the height minus that of the mean."""
    x, y, _ = upright_from_lidar(mean)[:3, :3] @ np.array(mounting.up)
    return np.array([x, y, mounting.height_m - mean.height_m])


def _mounting_at(
    mean: Mounting, deviation: Float[np.ndarray, "3"], height_deviation_m: float, tilt_deviation_deg: float
) -> Mounting:
    """Mounting whose `_deviation` from the mean is `deviation`, with standard deviations of its height and tilt."""
    x, y, height_m = deviation.tolist()
    up = upright_from_lidar(mean)[:3, :3].T @ np.array([x, y, np.sqrt(max(1 - x * x - y * y, 0.0))])
    up = up / np.linalg.norm(up)
    return Mounting(mean.height_m + height_m, tuple(up.tolist()), height_deviation_m, tilt_deviation_deg)


def _averaged_along_path(
    ups: Float[np.ndarray, "n 3"], weights: Float[np.ndarray, " n"], path_m: Float[np.ndarray, " n"]
) -> Float[np.ndarray, "n 3"]:
    """Weighted Gaussian average of directions along a path. `path_m` is the travelled distance at each direction."""
    from scipy.ndimage import gaussian_filter1d  # imported here because the import is slow

    metre = path_m.astype(np.int64)
    sum_of_metre = np.zeros((metre[-1] + 1, 3))
    np.add.at(sum_of_metre, metre, ups * weights[:, None])
    means = gaussian_filter1d(sum_of_metre, AVERAGED_M, axis=0, mode="constant")[metre]
    return means / np.linalg.norm(means, axis=1, keepdims=True)


def _spread_deg(ups: Float[np.ndarray, "n 3"], mean: Float[np.ndarray, "*n 3"]) -> float:
    """90 % quantile of the angles between directions and their mean (one for all, or one for each), in degrees."""
    return float(np.quantile(_angles_deg(ups, mean), 0.9))


def _angles_deg(a: Float[np.ndarray, "n 3"], b: Float[np.ndarray, "*n 3"]) -> Float[np.ndarray, " n"]:
    """Angles between unit vectors, in degrees."""
    return np.degrees(np.arccos(np.clip((a * b).sum(axis=1), -1, 1)))
