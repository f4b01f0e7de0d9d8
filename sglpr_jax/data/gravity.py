"""Mounting of a recording's sensor: given, or estimated from the ground; for one that tilts, at each scan.

The ground of a scan gives height and up. `GroundFilter` replaces ground that contradicts the scans before. With an IMU,
the ground must agree with it. With odometry, up is averaged over some metres of path.
"""

import contextlib
import dataclasses
import os
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from sglpr_jax.data.choices import Gravity, SensorHeight
from sglpr_jax.data.mounting import MODEL_HEIGHT_M, Mounting, common_mounting, estimate_mounting
from sglpr_jax.data.recording import Recording
from sglpr_jax.data.scan import Scan
from sglpr_jax.data.scan_stream import scan_stream
from sglpr_jax.data.warning import warn
from sglpr_jax.fields import check_value, require
from sglpr_jax.se3 import travelled

SCANS = 11
"""Number of scans for estimating the mounting, spread over the recording."""
SCANS_CHECKED = 3
"""Number of scans for checking the mounting that a layout defines."""
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
"""Standard deviations of up about each horizontal axis from an IMU, and of the ground relative to this up: roads have
slopes."""
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
"""Maximum angle between up of a scan and of odometry that shows the tilt, as a share of the tilt. Odometry in the plane
does not show it."""


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
        found = f"sensor: {mounting}, as given"
        recording = dataclasses.replace(recording, mounting=mounting, found=(*recording.found, found))
    return with_gravity(recording, recording.mounting or Mounting(MODEL_HEIGHT_M)) if gravity == "scan" else recording


def _estimated(recording: Recording, gravity: Gravity) -> Recording:
    """The recording with the mounting that some of its scans show."""
    each = _of_scans(recording, SCANS)
    mounting = common_mounting(each)
    hanging = [scan.up[2] < 0 for scan in each if scan is not None]
    if mounting is None:
        unclear = (
            f"ground found in {len(hanging)} of {len(each)} scans (is z up in these files?)"
            if 2 * len(hanging) < len(each)
            else f"the ground is below the sensor in {hanging.count(False)} of {len(each)} scans and above it in"
            f" {hanging.count(True)}"
        )
        found = f"sensor: {unclear}, assumed {MODEL_HEIGHT_M} m above the ground; set --sensor-height"
    else:
        agreed = hanging.count(mounting.up[2] < 0)
        found = f"sensor: {mounting}, estimated from the ground in {agreed} of {len(each)} scans"
    recording = dataclasses.replace(recording, mounting=mounting, found=(*recording.found, found))
    common = mounting or Mounting(MODEL_HEIGHT_M)
    same_side = [scan.up for scan in each if scan is not None and np.dot(scan.up, common.up) > 0]
    tilts = (
        mounting is not None
        and len(same_side) > 0
        and _spread_deg(np.array(same_side), np.array(common.up)) > TILTS_DEG
    )
    return with_gravity(recording, common) if gravity == "scan" or (gravity == "auto" and tilts) else recording


def _check_layout(recording: Recording) -> None:
    """Warn if the scans contradict the mounting of the layout, as scans of other sensors in KITTI's layout do."""
    believed = recording.mounting or Mounting(MODEL_HEIGHT_M)
    found = common_mounting(_of_scans(recording, SCANS_CHECKED))
    if found is None:
        return
    if abs(found.height_m - believed.height_m) > ELSEWHERE_M or found.tilt_deg > ELSEWHERE_DEG:
        warn(
            f"sequence {recording.name}: expected the sensor {believed}, as its layout defines, found it {found}; for"
            " another sensor pass --sensor-height estimate, or its height in metres"
        )


def _of_scans(recording: Recording, scans: int) -> list[Mounting | None]:
    """Estimate the mounting from some scans, spread over the recording, or None for unreadable ones."""
    found: list[Mounting | None] = []
    for row in np.unique(np.linspace(0, len(recording) - 1, scans).astype(int)).tolist():
        found.append(None)
        with contextlib.suppress(ValueError, OSError):
            found[-1] = estimate_mounting(recording.points(row))
    return found


class GroundFilter:
    """Kalman filter of height and up over consecutive scans.

    The prediction is the last state, drawn towards the mean. Ground that contradicts the prediction is ignored.

    Example:
      gravity = sglpr_jax.GroundFilter(sglpr_jax.estimate_mounting(first_points))
      record = sglpr_jax.Record(points=points, mounting=gravity.add(points))
    """

    def __init__(self, mean: Mounting, *, spread_deg: float = SPREAD_DEG, spread_m: float = SPREAD_M):
        """Start at the mean mounting, with standard deviations of up about each horizontal axis and of the height."""
        self.mean = mean
        self.followed = 0
        """Number of scans whose ground was used."""
        self._spread = np.array([np.radians(spread_deg)] * 2 + [spread_m]) ** 2
        self._noise = np.array([np.radians(GROUND_TILT_DEG)] * 2 + [GROUND_HEIGHT_M]) ** 2
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
        predicted, variance = MEMORY * self._state, MEMORY**2 * self._variance + (1 - MEMORY**2) * spread
        if ground is not None:
            ahead = _apart(ground, mean) - predicted
            if np.sum(ahead**2 / (variance + noise)) <= GATE**2:
                self.followed += 1
                gain = variance / (variance + noise)
                predicted, variance = predicted + gain * ahead, variance * (1 - gain)
        self._state, self._variance = predicted, variance
        tilt_deg = float(np.degrees(np.sqrt(variance[:2].mean())))
        return _beside(mean, predicted, float(np.sqrt(variance[2])), tilt_deg)


def with_gravity(recording: Recording, common: Mounting) -> Recording:
    """Estimate the mounting of each scan of a recording about a mean mounting. This reads all scans."""

    def ground_of(row: int, scan: Scan) -> Mounting | None:
        assert scan.points is not None
        return estimate_mounting(scan.points, near=common)

    options = {"ahead": os.cpu_count() or 1, "on_bad_scan": lambda scan, error: None}
    ground = [found for _, found in scan_stream(recording, ground_of, **options)]
    seen = [scan for scan in ground if scan is not None] or [common]
    apart = np.array([_apart(scan, common) for scan in seen])
    middle = np.median(apart, axis=0)
    mean = _beside(common, middle, 0.0, 0.0)
    spread = 1.4826 * np.median(np.abs(apart - middle), axis=0)  # of a normal distribution
    filtered = GroundFilter(
        mean,
        spread_deg=max(float(np.degrees(spread[:2].max())), LEAST_SPREAD_DEG),
        spread_m=max(float(spread[2]), LEAST_SPREAD_M),
    )
    ups, source = _ups_by_imu(recording, ground)
    mountings = tuple(filtered.update(scan, up=up) for scan, up in zip(ground, ups, strict=True))
    spread_deg = _spread_deg(np.array([scan.up for scan in seen]), np.array(mean.up))
    found = (
        f"gravity: the sensor tilts by {spread_deg:.0f} degrees about its mean; height and tilt of each scan from the "
        f"ground in {filtered.followed} of {len(ground)} scans{source}"
    )
    return dataclasses.replace(recording, mountings=mountings, read_ups=None, found=(*recording.found, found))


def _ups_by_imu(
    recording: Recording, ground: Sequence[Mounting | None]
) -> tuple[list[Float[np.ndarray, "3"] | None], str]:
    """Up at each scan by the IMU, or None without samples, and its source in words.

    An IMU that contradicts the ground is not used for any scan.
    """
    without: list[Float[np.ndarray, 3] | None] = [None] * len(recording)
    read = None if recording.read_ups is None else recording.read_ups()
    if read is None:
        return without, ""
    ups, source = read
    found = [up if np.isfinite(up).all() else None for up in ups]
    share = np.mean([up is not None for up in found])
    if share < LEAST_SHARE:
        return without, f"; {source}, has samples at only {share:.0%} of the scans and is not used"
    both = [(up, scan.up) for up, scan in zip(found, ground, strict=True) if up is not None and scan is not None]
    apart = np.median(_angles_deg(*np.array(both).swapaxes(0, 1))) if both else 0.0
    if apart > IMU_APART_DEG:
        return without, f"; {source}, is {apart:.0f} degrees apart from the ground and is not used"
    return found, f" and from {source}"


def with_odometry(recording: Recording, world_from_lidar: Float[np.ndarray, "n 4 4"]) -> Recording:
    """Average up of each scan over the path by the poses of the LiDAR, if the recording has `mountings`.

    Odometry that does not show the tilt, as that of wheels, is not used.
    """
    if recording.mountings is None:
        return recording
    turn, each = world_from_lidar[:, :3, :3], np.array([one.up for one in recording.mountings])
    up = np.einsum("nij,nj->ni", turn, each)
    weight = np.array([1 / (one.tilt_deviation_deg or GROUND_TILT_DEG) ** 2 for one in recording.mountings])
    mean = _averaged(up, weight, travelled(world_from_lidar))
    middle = np.median(each, axis=0)
    left = _spread_deg(up, mean)
    if left > EXPLAINED * _spread_deg(each, middle / np.linalg.norm(middle)):
        found = "gravity: the odometry does not show the tilt of the scans; their ground is used"
        return dataclasses.replace(recording, found=(*recording.found, found))
    ups = np.einsum("nji,nj->ni", turn, mean).tolist()
    mountings = tuple(
        dataclasses.replace(one, up=tuple(up), tilt_deviation_deg=ODOMETRY_TILT_DEG)
        for one, up in zip(recording.mountings, ups, strict=True)
    )
    found = f"gravity: tilt of each scan from the odometry and the ground, {left:.1f} degrees apart"
    return dataclasses.replace(recording, mountings=mountings, found=(*recording.found, found))


def _apart(one: Mounting, mean: Mounting) -> Float[np.ndarray, "3"]:
    """Up of a mounting in the upright frame of the mean (x and y), and its height relative to the mean."""
    x, y, _ = mean.upright_from_lidar @ np.array(one.up)
    return np.array([x, y, one.height_m - mean.height_m])


def _beside(mean: Mounting, apart: Float[np.ndarray, "3"], deviation_m: float, deviation_deg: float) -> Mounting:
    """Inverse of `_apart`."""
    x, y, height = apart.tolist()
    up = mean.upright_from_lidar.T @ np.array([x, y, np.sqrt(max(1 - x * x - y * y, 0.0))])
    up = up / np.linalg.norm(up)
    return Mounting(mean.height_m + height, tuple(up.tolist()), deviation_m, deviation_deg)


def _averaged(
    values: Float[np.ndarray, "n 3"], weight: Float[np.ndarray, " n"], way_m: Float[np.ndarray, " n"]
) -> Float[np.ndarray, "n 3"]:
    """Weighted Gaussian average of directions along a path."""
    from scipy.ndimage import gaussian_filter1d  # imported here because the import is slow

    metre = way_m.astype(np.int64)
    sums = np.zeros((metre[-1] + 1, 3))
    np.add.at(sums, metre, values * weight[:, None])
    mean = gaussian_filter1d(sums, AVERAGED_M, axis=0, mode="constant")[metre]
    return mean / np.linalg.norm(mean, axis=1, keepdims=True)


def _spread_deg(ups: Float[np.ndarray, "n 3"], mean: Float[np.ndarray, "*n 3"]) -> float:
    """90 % quantile of the angle between directions and their mean, in degrees."""
    return float(np.quantile(_angles_deg(ups, mean), 0.9))


def _angles_deg(ups: Float[np.ndarray, "n 3"], others: Float[np.ndarray, "*n 3"]) -> Float[np.ndarray, " n"]:
    return np.degrees(np.arccos(np.clip((ups * others).sum(axis=1), -1, 1)))
