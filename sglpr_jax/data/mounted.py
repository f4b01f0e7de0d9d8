"""Recordings that know how their sensor was mounted: said by the user, or found from their scans."""

import dataclasses

import numpy as np

from sglpr_jax.data.choices import SensorHeight
from sglpr_jax.data.mounting import MODEL_HEIGHT_M, Mounting, common_mounting, estimate_mounting
from sglpr_jax.data.recording import Recording

SCANS = 11
"""From so many scans, all over a recording, the mounting is found."""


def mounted(recording: Recording, height: SensorHeight, *, known: bool) -> Recording:
    """The recording with the mounting that `height` asks for, and what was found in words.

    `known` says that the layout's scans are mounted as models know them. Where no ground is found nothing is changed.
    """
    if recording.has_images or (height == "auto" and known):
        return recording
    if height in ("auto", "estimate"):
        return _estimated(recording)
    mounting = Mounting(float(height))
    return dataclasses.replace(recording, mounting=mounting, found=(*recording.found, f"sensor: {mounting}, as said"))


def _estimated(recording: Recording) -> Recording:
    rows = np.unique(np.linspace(0, len(recording) - 1, SCANS).astype(int))
    each = [_of_scan(recording, int(row)) for row in rows]
    mounting, seen = common_mounting(each), sum(found is not None for found in each)
    if mounting is None:
        found = (
            f"sensor: no ground found but in {seen} of {len(rows)} scans, taken to be {MODEL_HEIGHT_M} m above it;"
            " say --sensor-height"
        )
    else:
        found = f"sensor: {mounting}, estimated from the ground in {seen} of {len(rows)} scans"
    return dataclasses.replace(recording, mounting=mounting, found=(*recording.found, found))


def _of_scan(recording: Recording, row: int) -> Mounting | None:
    """The mounting that one scan tells; a scan that cannot be read tells none."""
    try:
        return estimate_mounting(recording.points(row))
    except (ValueError, OSError):
        return None
