"""Recordings that know how their sensor was mounted: said by the user, or found from their scans."""

import dataclasses

import numpy as np

from sglpr_jax.data.choices import SensorHeight
from sglpr_jax.data.mounting import MODEL_HEIGHT_M, Mounting, common_mounting, estimate_mounting
from sglpr_jax.data.recording import Recording
from sglpr_jax.data.warning import warn
from sglpr_jax.fields import require

SCANS = 11
"""From so many scans, all over a recording, the mounting is found."""
SCANS_CHECKED = 3
"""So many tell whether a sensor stands where its layout has it."""
ELSEWHERE_M, ELSEWHERE_DEG = 0.4, 10.0
"""A sensor so much higher, lower or more tilted than that is another one."""


def mounted(recording: Recording, height: SensorHeight, *, known: bool) -> Recording:
    """The recording with the mounting that `height` asks for, and what was found in words.

    `known` says that the layout tells how its scans are mounted; where their ground is elsewhere, a `DataWarning` says
    so. Where the ground does not tell it nothing is changed.
    """
    if recording.has_images:
        return recording
    if height == "auto" and known:
        _check_layout(recording)
        return recording
    if height in ("auto", "estimate"):
        return _estimated(recording)
    require(height, not isinstance(height, str), "metres over the ground, 'auto' or 'estimate'", "sensor_height")
    mounting = Mounting(float(height))
    return dataclasses.replace(recording, mounting=mounting, found=(*recording.found, f"sensor: {mounting}, as said"))


def _estimated(recording: Recording) -> Recording:
    each = _of_scans(recording, SCANS)
    mounting = common_mounting(each)
    hanging = [scan.up[2] < 0 for scan in each if scan is not None]
    if mounting is None:
        found = f"sensor: {_unclear(hanging, len(each))}, taken to be {MODEL_HEIGHT_M} m above it; say --sensor-height"
    else:
        agreed = hanging.count(mounting.up[2] < 0)
        found = f"sensor: {mounting}, estimated from the ground in {agreed} of {len(each)} scans"
    return dataclasses.replace(recording, mounting=mounting, found=(*recording.found, found))


def _unclear(hanging: list[bool], scans: int) -> str:
    """Why the scans tell no mounting; `hanging` says of each that shows ground whether the sensor hangs there."""
    if 2 * len(hanging) < scans:
        return f"ground found in {len(hanging)} of {scans} scans (is z up in these files?)"
    return f"the ground is below it in {hanging.count(False)} of {scans} scans and above it in {hanging.count(True)}"


def _check_layout(recording: Recording) -> None:
    """Warn where the ground lies elsewhere than the layout has it: other sensors' scans are often put into KITTI's."""
    believed = recording.mounting or Mounting(MODEL_HEIGHT_M)
    found = common_mounting(_of_scans(recording, SCANS_CHECKED))
    if found is None:
        return
    if abs(found.height_m - believed.height_m) > ELSEWHERE_M or found.tilt_deg > ELSEWHERE_DEG:
        warn(
            f"sequence {recording.name}: expected the sensor {believed}, as its layout has it, found it {found}; if it"
            " is another sensor say --sensor-height estimate, or its height in metres"
        )


def _of_scans(recording: Recording, scans: int) -> list[Mounting | None]:
    """What so many scans tell, all over the recording."""
    rows = np.unique(np.linspace(0, len(recording) - 1, scans).astype(int))
    return [_of_scan(recording, int(row)) for row in rows]


def _of_scan(recording: Recording, row: int) -> Mounting | None:
    """The mounting that one scan tells; a scan that cannot be read tells none."""
    try:
        return estimate_mounting(recording.points(row))
    except (ValueError, OSError):
        return None
