"""A scan or ready-made image from a file, to be found in a map."""

import dataclasses
from pathlib import Path

from sglpr_jax.data.choices import ScanFormat, SensorHeight
from sglpr_jax.data.formats.record_size import unusual_record
from sglpr_jax.data.formats.scan_files import says_its_format
from sglpr_jax.data.mounting import Mounting, estimate_mounting
from sglpr_jax.data.readers.bev_images import read_image
from sglpr_jax.data.record import Record, scan_record
from sglpr_jax.loops.places import PlaceMap


def read_query(
    path: Path, places: PlaceMap, *, format: ScanFormat = "auto", sensor_height: SensorHeight = "auto"
) -> Record:
    """Read what `places.relocate` looks for: a scan of this format, or an image (.png).

    "auto" looks into a .bin whose name says nothing, as opening a folder of such does.
    `sensor_height` is metres above the ground, "estimate" finds it and the tilt from the scan, "auto" takes the
    mounting of the map's last place. Raises what `scan_record` and `read_image` do, IsADirectoryError for a folder, and
    ValueError where there is no ground to estimate from.
    """
    if path.is_dir():
        raise IsADirectoryError(f"{path}: expected one scan or image, found a folder; name a file in it")
    if path.suffix == ".png":
        return Record(image=read_image(path))
    record = scan_record(path, format=_found(path) if format == "auto" else format)
    if sensor_height == "auto":
        return dataclasses.replace(record, mounting=places.mounting())
    if sensor_height != "estimate":
        return dataclasses.replace(record, mounting=Mounting(float(sensor_height)))
    assert record.points is not None
    found = estimate_mounting(record.points)
    if found is None:
        raise ValueError(f"{path}: expected ground that tells the sensor's height, found none: say how high")
    return dataclasses.replace(record, mounting=found)


def _found(path: Path) -> ScanFormat:
    """What a .bin holds whose name says nothing, where it is not what "auto" takes it for."""
    unsaid = path.is_file() and not says_its_format(path)
    return (unusual_record([path]) if unsaid else None) or "auto"
