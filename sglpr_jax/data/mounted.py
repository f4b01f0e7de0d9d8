"""Adds the sensor mounting to a recording, either from the user or estimated from the scans."""

import dataclasses

import numpy as np

from sglpr_jax.data.choices import Gravity, SensorHeight
from sglpr_jax.data.gravity import tilts, with_gravity
from sglpr_jax.data.mounting import MODEL_HEIGHT_M, Mounting, common_mounting, estimate_mounting
from sglpr_jax.data.recording import Recording
from sglpr_jax.data.warning import warn
from sglpr_jax.fields import check_value, require

SCANS = 11
"""Number of scans for estimating the mounting, spread over the recording."""
SCANS_CHECKED = 3
"""Number of scans for checking the mounting that a layout defines."""
ELSEWHERE_M, ELSEWHERE_DEG = 0.4, 10.0
"""Maximum height difference, in metres, and maximum tilt, in degrees, of a sensor that fits its layout."""


def mounted(recording: Recording, height: SensorHeight, *, gravity: Gravity = "auto", known: bool) -> Recording:
    """Return the recording with its sensor mounting, and a description of the mounting in `Recording.found`.

    Recordings of images are returned unchanged. If the ground does not show the mounting, it stays unknown, and
    models assume a sensor 1.73 m above the ground.

    Arguments:
      recording: Recording of scans or images.
      height: Height above the ground in metres, "estimate" or "auto". "auto" estimates the mounting only if the layout
        does not define it.
      gravity: "recording" uses one mounting for all scans, "scan" estimates height and up of each scan. "auto" does so
        if the mounting is estimated and the sensor tilts (`gravity.tilts`).
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
    each = _of_scans(recording, SCANS)
    mounting = common_mounting(each)
    hanging = [scan.up[2] < 0 for scan in each if scan is not None]
    if mounting is None:
        found = (
            f"sensor: {_unclear(hanging, len(each))}, assumed {MODEL_HEIGHT_M} m above the ground; set --sensor-height"
        )
    else:
        agreed = hanging.count(mounting.up[2] < 0)
        found = f"sensor: {mounting}, estimated from the ground in {agreed} of {len(each)} scans"
    recording = dataclasses.replace(recording, mounting=mounting, found=(*recording.found, found))
    if gravity == "scan" or (gravity == "auto" and tilts(each, mounting)):
        return with_gravity(recording, mounting or Mounting(MODEL_HEIGHT_M))
    return recording


def _unclear(hanging: list[bool], scans: int) -> str:
    """Explain why the scans show no mounting. `hanging` states for each scan with ground whether the sensor is upside
    down."""
    if 2 * len(hanging) < scans:
        return f"ground found in {len(hanging)} of {scans} scans (is z up in these files?)"
    return (
        f"the ground is below the sensor in {hanging.count(False)} of {scans} scans and above it in"
        f" {hanging.count(True)}"
    )


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
    """Estimate the mounting from each of a number of scans, spread over the recording."""
    rows = np.unique(np.linspace(0, len(recording) - 1, scans).astype(int))
    return [_of_scan(recording, int(row)) for row in rows]


def _of_scan(recording: Recording, row: int) -> Mounting | None:
    """Estimate the mounting from one scan, or return None if the scan cannot be read."""
    try:
        return estimate_mounting(recording.points(row))
    except (ValueError, OSError):
        return None
