"""Query scans and images from files, for relocalisation in a map."""

import dataclasses
from pathlib import Path

import numpy as np

from sglpr_jax.data.choices import ScanFormat, SensorHeight
from sglpr_jax.data.formats.scan_files import detect_format, scan_of_file
from sglpr_jax.data.mounting import Mounting, estimate_mounting
from sglpr_jax.data.readers.bev_images import read_image
from sglpr_jax.data.readers.ros import ENDINGS
from sglpr_jax.data.recording import Recording
from sglpr_jax.data.scan import Scan
from sglpr_jax.maps.place_map import PlaceMap


def read_query(
    path: Path, places: PlaceMap, *, format: ScanFormat = "auto", sensor_height: SensorHeight = "auto"
) -> Scan:
    """Read a query for `PlaceMap.relocate`.

    Arguments:
      path: File of a scan, or of an image (.png).
      places: Map in which the query will be located.
      format: Format of the scan. "auto" uses the file name or, for a .bin that does not state the format, the content.
      sensor_height: Height of the sensor above the ground, in metres. "estimate" estimates height and tilt from the
        scan. "auto" uses `PlaceMap.query_mounting`.

    Raises:
      IsADirectoryError: If `path` is a folder.
      ValueError: If `path` is a bag, or if height and tilt cannot be estimated, because the scan shows no ground.
        Errors of `scan_of_file` and `read_image` are raised, too.
    """
    expected = f"{path}: expected one scan or image"
    if path.is_dir():
        raise IsADirectoryError(f"{expected}, found a folder; name a file in it, or use --frame")
    if path.suffix in ENDINGS:
        raise ValueError(f"{expected}, found a bag; use --frame")
    if path.suffix == ".png":
        return Scan(image=read_image(path))
    scan = scan_of_file(path, format=detect_format(path) if format == "auto" else format)
    if sensor_height == "auto":
        mounting = places.query_mounting(scan.cloud)
    elif sensor_height == "estimate":
        mounting = estimate_mounting(scan.cloud)
    else:
        mounting = Mounting(float(sensor_height))
    if mounting is None:
        raise ValueError(f"{path}: expected ground to estimate the sensor's height, found none; state the height")
    return dataclasses.replace(scan, mounting=mounting)


def query_of(recording: Recording, frame: int) -> Scan:
    """Read the scan with this number from a recording, as a query for `PlaceMap.relocate`. Raises ValueError if the
    recording has no such scan, or if it is left out because it has no pose."""
    rows = np.flatnonzero(recording.numbers == frame)
    if not rows.size:
        scans = f"{len(recording)} scans from {recording.numbers[0]} to {recording.numbers[-1]}"
        raise ValueError(f"{recording.name}: expected the number of a scan, found {frame}; it has {scans}")
    return recording.scan(int(rows[0]), labels=False)
