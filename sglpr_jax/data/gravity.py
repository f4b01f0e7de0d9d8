"""Mounting of a recording's sensor: given, or estimated from the ground; for a sensor that tilts, at each scan.

The ground of a scan gives height and up. `GroundFilter` replaces ground that contradicts the scans before. With an IMU,
the ground must agree with it. With odometry, up is averaged over some metres of path.
"""

import dataclasses
import os
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from sglpr_jax.data.choices import Gravity, SensorHeight
from sglpr_jax.data.mounting import (
    MODEL_HEIGHT_M,
    Mounting,
    common_mounting,
    estimate_mounting,
    upright_from_lidar,
)
from sglpr_jax.data.recording import Recording
from sglpr_jax.data.scan import Scan
from sglpr_jax.data.scan_stream import sampled_points, scan_stream
from sglpr_jax.fields import check_value, require
from sglpr_jax.files import warn
from sglpr_jax.se3 import inverse, travelled

SCANS, SCANS_CHECKED = 11, 3
"""Number of scans, spread over the recording, for estimating the mounting and for checking that of a layout."""
ELSEWHERE_M, ELSEWHERE_DEG = 0.4, 10.0
"""Maximum height difference, in metres, and maximum tilt, in degrees, of a sensor that fits its layout."""
TILTS_DEG = 3.0
"""90 % quantile of the angle between up of the scans and its median above which a sensor tilts, in degrees."""
GROUND_TILT_DEG, GROUND_HEIGHT_M = 0.25, 0.03
"""Standard deviations of up about each horizontal axis, and of the height, from the ground of one scan."""
SPREAD_DEG, SPREAD_M = 8.0, 0.15
"""Standard deviations of a sensor in a hand about its mean, for a stream whose scans are not known in advance."""
LEAST_SPREAD_DEG, LEAST_SPREAD_M = 2.0, 0.05
"""Minimum of these standard deviations."""
IMU_TILT_DEG, SLOPE_DEG = 1.0, 1.0
"""Standard deviations of up about each horizontal axis by an IMU, and of the slope of the ground."""
IMU_APART_DEG = 10.0
"""Maximum median angle between up by an IMU and by the ground. Beyond it, the axes of the IMU are wrong."""
LEAST_SHARE = 0.5
"""Minimum share of scans with samples of the IMU."""
MEMORY = 0.8
"""Share of the deviation from the mean that remains until the next scan. A hand turns within a second."""
GATE = 4.6
"""Maximum deviation of the ground of a scan from its prediction, in standard deviations of 3 degrees of freedom."""
AVERAGED_M = 8.0
"""Standard deviation of the Gaussian over which up is averaged along the path, in metres."""
ODOMETRY_TILT_DEG = 0.3
"""Standard deviation of up about each horizontal axis, averaged with odometry."""
EXPLAINED = 0.5
"""Maximum angle between up of a scan and of odometry that shows the tilt, as a share of the tilt."""
LEAST_PATH_M = 20.0
"""Minimum path length for the check of poses, in metres."""
STEEPEST = 0.7
"""Maximum share of a vehicle's path that goes up or down: the sine of 45 degrees."""


def mounted(recording: Recording, height: SensorHeight, *, gravity: Gravity = "auto", known: bool) -> Recording:
    """Return the recording with its sensor mounting, and a description of the mounting in `Recording.found`.

    If the ground does not show the mounting, it stays unknown, and models assume a sensor 1.73 m above the ground.

    Arguments:
      recording: Recording of scans. A recording of images is returned unchanged.
      height: Height above the ground in metres, "estimate" or "auto". "auto" estimates the mounting only if the layout
        does not define it.
      gravity: "recording" uses one mounting for all scans, "scan" estimates height and up of each scan. "auto" does so
        if the mounting is estimated and the sensor tilts by more than `TILTS_DEG`.
      known: Whether the layout defines the mounting. If the scans contradict it, "auto" issues a `DataWarning`.
    """
    if recording.has_images:
        return recording
    check_value(gravity, Gravity, "gravity")
    if height == "auto" and known:
        _check_layout(recording)
    elif height in ("auto", "estimate"):
        return _estimated(recording, gravity)
    else:
        require(height, not isinstance(height, str), "metres above the ground, 'auto' or 'estimate'", "sensor_height")
        mounting = Mounting(float(height))
        recording = recording.noting(f"sensor: {mounting}, as given", mounting=mounting)
    return with_gravity(recording, recording.mounting or Mounting(MODEL_HEIGHT_M)) if gravity == "scan" else recording


def _estimated(recording: Recording, gravity: Gravity) -> Recording:
    """The recording with the mounting that some of its scans show."""
    scans = _of_scans(recording, SCANS)
    estimates = [scan for scan in scans if scan is not None]
    mounting = common_mounting(scans)
    hanging = sum(scan.up[2] < 0 for scan in estimates)
    if mounting is None:
        unclear = (
            f"ground found in {len(estimates)} of {len(scans)} scans (is z up in these files?)"
            if 2 * len(estimates) < len(scans)
            else f"the ground is below the sensor in {len(estimates) - hanging} of {len(scans)} scans and above it in"
            f" {hanging}"
        )
        note = f"sensor: {unclear}, assumed {MODEL_HEIGHT_M} m above the ground; set --sensor-height"
    else:
        agreeing = hanging if mounting.up[2] < 0 else len(estimates) - hanging
        note = f"sensor: {mounting}, estimated from the ground in {agreeing} of {len(scans)} scans"
    recording = recording.noting(note, mounting=mounting)
    common = mounting or Mounting(MODEL_HEIGHT_M)
    ups = np.array([scan.up for scan in estimates if np.dot(scan.up, common.up) > 0])
    tilts = mounting is not None and len(ups) > 0 and _spread_deg(ups, np.array(common.up)) > TILTS_DEG
    return with_gravity(recording, common) if gravity == "scan" or (gravity == "auto" and tilts) else recording


def _check_layout(recording: Recording) -> None:
    """Warn if the scans contradict the mounting of the layout, as scans of other sensors in KITTI's layout do."""
    expected = recording.mounting or Mounting(MODEL_HEIGHT_M)
    mounting = common_mounting(_of_scans(recording, SCANS_CHECKED))
    if mounting is None:
        return
    if abs(mounting.height_m - expected.height_m) > ELSEWHERE_M or mounting.tilt_deg > ELSEWHERE_DEG:
        warn(
            f"sequence {recording.name}: expected the sensor {expected}, as its layout defines, found it {mounting};"
            " for another sensor pass --sensor-height estimate, or its height in metres"
        )


def _of_scans(recording: Recording, scans: int) -> list[Mounting | None]:
    """Estimate the mounting from some scans, spread over the recording, or None for unreadable ones."""
    clouds = sampled_points(recording, scans)
    return [None if points is None else estimate_mounting(points) for points in clouds]


class GroundFilter:
    """Kalman filter of height and up over consecutive scans.

    The prediction is the last state, drawn towards the mean. Ground that contradicts the prediction is ignored.

    Example:
      gravity = sglpr_jax.GroundFilter(sglpr_jax.estimate_mounting(first_points))
      scan = sglpr_jax.Scan(points=points, mounting=gravity.add(points))
    """

    def __init__(self, mean: Mounting, *, spread_deg: float = SPREAD_DEG, spread_m: float = SPREAD_M):
        """Start at the mean mounting, with standard deviations of up about each horizontal axis and of the height."""
        self.mean = mean
        self.followed = 0
        """Number of scans whose ground was used."""
        self._spread = _variances(spread_deg, spread_m)
        self._noise = _variances(GROUND_TILT_DEG, GROUND_HEIGHT_M)
        self._state, self._variance = np.zeros(3), self._spread

    def add(self, points: Float[np.ndarray, "n 3"]) -> Mounting:
        """Estimate the mounting at the next scan from its points (n, 3), in metres."""
        return self.update(estimate_mounting(points, near=self.mean))

    def update(self, ground: Mounting | None, *, up: Float[np.ndarray, "3"] | None = None) -> Mounting:
        """Add the mounting by the ground of the next scan, or None for a scan without ground.

        `up` is up in the LiDAR frame by an IMU, which replaces the mean. Use it for all scans or for none.
        """
        mean, spread, noise = self.mean, self._spread, self._noise
        if up is not None:
            mean = dataclasses.replace(mean, up=tuple(up.tolist()))
            spread = np.array([*[np.radians(IMU_TILT_DEG) ** 2] * 2, spread[2]])
            noise = np.array([*[np.radians(SLOPE_DEG) ** 2] * 2, noise[2]])
        state, variance = MEMORY * self._state, MEMORY**2 * self._variance + (1 - MEMORY**2) * spread
        if ground is not None:
            innovation = _deviation(ground, mean) - state
            if np.sum(innovation**2 / (variance + noise)) <= GATE**2:
                self.followed += 1
                gain = variance / (variance + noise)
                state, variance = state + gain * innovation, variance * (1 - gain)
        self._state, self._variance = state, variance
        tilt_deg = float(np.degrees(np.sqrt(variance[:2].mean())))
        return _deviating(mean, state, float(np.sqrt(variance[2])), tilt_deg)


def with_gravity(recording: Recording, common: Mounting) -> Recording:
    """Estimate the mounting of each scan of a recording about a mean mounting. This reads all scans."""

    def ground_of(row: int, scan: Scan) -> Mounting | None:
        return estimate_mounting(scan.cloud, near=common)

    options = {"ahead": os.cpu_count() or 1, "on_bad_scan": lambda scan, error: None}
    ground = [mounting for _, mounting in scan_stream(recording, ground_of, **options)]
    estimates = [mounting for mounting in ground if mounting is not None] or [common]
    deviations = np.array([_deviation(mounting, common) for mounting in estimates])
    median = np.median(deviations, axis=0)
    mean = _deviating(common, median, 0.0, 0.0)
    spread = 1.4826 * np.median(np.abs(deviations - median), axis=0)  # of a normal distribution
    ground_filter = GroundFilter(
        mean,
        spread_deg=max(float(np.degrees(spread[:2].max())), LEAST_SPREAD_DEG),
        spread_m=max(float(spread[2]), LEAST_SPREAD_M),
    )
    ups, source = _ups_by_imu(recording, ground)
    mountings = tuple(ground_filter.update(mounting, up=up) for mounting, up in zip(ground, ups, strict=True))
    spread_deg = _spread_deg(np.array([mounting.up for mounting in estimates]), np.array(mean.up))
    note = (
        f"gravity: the sensor tilts by {spread_deg:.0f} degrees about its mean; height and tilt of each scan from the "
        f"ground in {ground_filter.followed} of {len(ground)} scans{source}"
    )
    return recording.noting(note, mountings=mountings, read_ups=None)


def _ups_by_imu(
    recording: Recording, ground: Sequence[Mounting | None]
) -> tuple[list[Float[np.ndarray, "3"] | None], str]:
    """Up at each scan by the IMU, or None without samples, and its source in words.

    An IMU that contradicts the ground is not used for any scan.
    """
    unknown: list[Float[np.ndarray, 3] | None] = [None] * len(recording)
    imu = None if recording.read_ups is None else recording.read_ups()
    if imu is None:
        return unknown, ""
    measured, source = imu
    ups = [up if np.isfinite(up).all() else None for up in measured]
    share = np.mean([up is not None for up in ups])
    if share < LEAST_SHARE:
        return unknown, f"; {source}, has samples at only {share:.0%} of the scans and is not used"
    pairs = [(up, scan.up) for up, scan in zip(ups, ground, strict=True) if up is not None and scan is not None]
    angle_deg = np.median(_angles_deg(*np.array(pairs).swapaxes(0, 1))) if pairs else 0.0
    if angle_deg > IMU_APART_DEG:
        return unknown, f"; {source}, is {angle_deg:.0f} degrees apart from the ground and is not used"
    return ups, f" and from {source}"


def with_odometry(recording: Recording, world_from_lidar: Float[np.ndarray, "n 4 4"]) -> Recording:
    """Average up of each scan over the path by the poses of the LiDAR, if the recording has `mountings`.

    Odometry that does not show the tilt, as that of wheels, is not used. Poses of a path that goes mostly up or down
    are probably in camera axes, with z forward: a `DataWarning` says so.
    """
    _check_climb(recording, world_from_lidar)
    if recording.mountings is None:
        return recording
    world_from_scan, ups = world_from_lidar[:, :3, :3], np.array([mounting.up for mounting in recording.mountings])
    world_ups = np.einsum("nij,nj->ni", world_from_scan, ups)
    deviations_deg = [mounting.tilt_deviation_deg or GROUND_TILT_DEG for mounting in recording.mountings]
    means = _averaged(world_ups, 1 / np.array(deviations_deg) ** 2, travelled(world_from_lidar))
    median = np.median(ups, axis=0)
    angle_deg = _spread_deg(world_ups, means)
    if angle_deg > EXPLAINED * _spread_deg(ups, median / np.linalg.norm(median)):
        return recording.noting("gravity: the odometry does not show the tilt of the scans; their ground is used")
    mountings = tuple(
        dataclasses.replace(mounting, up=tuple(up), tilt_deviation_deg=ODOMETRY_TILT_DEG)
        for mounting, up in zip(
            recording.mountings, np.einsum("nji,nj->ni", world_from_scan, means).tolist(), strict=True
        )
    )
    note = f"gravity: tilt of each scan from the odometry and the ground, {angle_deg:.1f} degrees apart"
    return recording.noting(note, mountings=mountings)


def _check_climb(recording: Recording, world_from_lidar: Float[np.ndarray, "n 4 4"]) -> None:
    """Warn if the path goes mostly up or down."""
    steps = (inverse(world_from_lidar[:-1]) @ world_from_lidar[1:])[:, :3, 3]
    path_m = float(np.linalg.norm(steps, axis=1).sum())
    climbed_m = float(np.abs((steps * recording.uprights[:-1, 2, :3]).sum(axis=1)).sum())
    if path_m > LEAST_PATH_M and climbed_m > STEEPEST * path_m:
        warn(
            f"{recording.name}: expected poses of a LiDAR that moves along the ground (x forward, y left, z up), found "
            f"{climbed_m:.0f} of {path_m:.0f} m of path up or down; are they in camera axes (kitti)?"
        )


def _variances(tilt_deg: float, height_m: float) -> Float[np.ndarray, "3"]:
    """Variances of up about each horizontal axis (radians) and of the height (metres)."""
    return np.array([np.radians(tilt_deg)] * 2 + [height_m]) ** 2


def _deviation(mounting: Mounting, mean: Mounting) -> Float[np.ndarray, "3"]:
    """Up of a mounting in the upright frame of the mean (x and y), and its height relative to the mean."""
    x, y, _ = upright_from_lidar(mean)[:3, :3] @ np.array(mounting.up)
    return np.array([x, y, mounting.height_m - mean.height_m])


def _deviating(
    mean: Mounting, deviation: Float[np.ndarray, "3"], height_deviation_m: float, tilt_deviation_deg: float
) -> Mounting:
    """Mounting with a `_deviation` from the mean, and with these standard deviations."""
    x, y, height_m = deviation.tolist()
    up = upright_from_lidar(mean)[:3, :3].T @ np.array([x, y, np.sqrt(max(1 - x * x - y * y, 0.0))])
    up = up / np.linalg.norm(up)
    return Mounting(mean.height_m + height_m, tuple(up.tolist()), height_deviation_m, tilt_deviation_deg)


def _averaged(
    ups: Float[np.ndarray, "n 3"], weights: Float[np.ndarray, " n"], path_m: Float[np.ndarray, " n"]
) -> Float[np.ndarray, "n 3"]:
    """Weighted Gaussian average of directions along a path."""
    from scipy.ndimage import gaussian_filter1d  # imported here because the import is slow

    metre = path_m.astype(np.int64)
    sums = np.zeros((metre[-1] + 1, 3))
    np.add.at(sums, metre, ups * weights[:, None])
    means = gaussian_filter1d(sums, AVERAGED_M, axis=0, mode="constant")[metre]
    return means / np.linalg.norm(means, axis=1, keepdims=True)


def _spread_deg(ups: Float[np.ndarray, "n 3"], mean: Float[np.ndarray, "*n 3"]) -> float:
    """90 % quantile of the angle between directions and their mean, in degrees."""
    return float(np.quantile(_angles_deg(ups, mean), 0.9))


def _angles_deg(ups: Float[np.ndarray, "n 3"], others: Float[np.ndarray, "*n 3"]) -> Float[np.ndarray, " n"]:
    return np.degrees(np.arccos(np.clip((ups * others).sum(axis=1), -1, 1)))
