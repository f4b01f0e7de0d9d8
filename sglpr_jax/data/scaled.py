"""Scale of a recording: a factor of its lengths, so that scans of rooms or of a short-range sensor fill an image.

An image shows 25 m in each direction, in cells of 0.4 m. With a factor of 4, it shows 6.25 m in cells of 0.1 m. The
same weights are used.
"""

import dataclasses

import numpy as np
from jaxtyping import Float

from sglpr_jax.data.choices import SCALE, Scale
from sglpr_jax.data.mounting import MODEL_HEIGHT_M, Mounting
from sglpr_jax.data.recording import Recording
from sglpr_jax.data.scan import Scan, are_measured
from sglpr_jax.data.scan_stream import sampled_points
from sglpr_jax.fields import check_value

SCANS = 11
"""Number of scans from which the scale is chosen, spread over the recording."""
FAR_M = 8.0
"""Minimum range of a sensor whose scans are not scaled, in metres. Simulated corridors and rooms have 5 to 6 m,
warehouses 9 to 13 m, and garages and streets 12 m or more (`benchmarks/quality/sensors.py`)."""
NEAR_SCALE: Scale = 4
"""Scale of recordings with a range below `FAR_M`."""


def scaled(recording: Recording, scale: Scale) -> Recording:
    """Return a recording whose points and sensor heights are multiplied by `scale` when scans are read.

    Raises ValueError if the factor is not 1, 2 or 4, or if a recording of ready-made images has a factor other than 1.
    """
    check_value(scale, Scale, "scale")
    if scale == 1:
        return recording
    recording.require_scans(f"scans to scale by {scale}")
    mountings = recording.mountings
    return recording.with_reader(
        lambda row, label_path: scaled_scan(recording.read_row(row, label_path), scale),
        options={SCALE: str(scale)},
        mounting=_scaled_mounting(recording.mounting, scale),
        mountings=None if mountings is None else tuple(_scaled_mounting(mounting, scale) for mounting in mountings),
    )


def chosen_scale(recording: Recording) -> Scale:
    """Choose the scale of a recording: `NEAR_SCALE` if the range of the sensor is below `FAR_M`, otherwise 1.

    The range is the median over some scans of the 90 % quantile of the horizontal distances of their points. Recordings
    of images and unreadable recordings have scale 1.
    """
    if recording.has_images or not len(recording):
        return 1
    ranges_m = []
    for points in sampled_points(recording, SCANS):
        if points is None:
            continue
        measured = points[are_measured(points)]
        if len(measured):
            ranges_m.append(np.quantile(np.hypot(*measured[:, :2].T), 0.9))
    return NEAR_SCALE if ranges_m and np.median(ranges_m) < FAR_M else 1


def scale_of(recording: Recording) -> int:
    """Scale of a recording that `scaled` returned. 1 for any other recording."""
    return int(recording.read_options.get(SCALE, "1"))


def scaled_scan(scan: Scan, scale: Scale) -> Scan:
    """Return a scan with its points and sensor height multiplied by `scale`. Raises ValueError for an image."""
    if scale == 1:
        return scan
    if scan.points is None:
        raise ValueError(f"{scan.name or 'scan'}: expected points to scale by {scale}, found an image")
    points = scan.points * np.float32(scale)
    return dataclasses.replace(scan, points=points, mounting=_scaled_mounting(scan.mounting, scale))


def scaled_poses(poses: Float[np.ndarray, "*n 4 4"], factor: float) -> Float[np.ndarray, "*n 4 4"]:
    """Return poses with their translations multiplied by `factor`."""
    poses = np.array(poses, np.float64)
    poses[..., :3, 3] *= factor
    return poses


def _scaled_mounting(mounting: Mounting | None, scale: Scale) -> Mounting:
    """Scale a mounting. An unknown mounting is 1.73 m above the ground before scaling, as models assume."""
    return (mounting or Mounting(MODEL_HEIGHT_M)).scaled(scale)
