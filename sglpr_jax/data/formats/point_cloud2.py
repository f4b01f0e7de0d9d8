"""Reads sensor_msgs/PointCloud2 messages of ROS, with any field layout, either byte order, and padded rows.

The drivers of Velodyne, Ouster, Hesai and Livox use different layouts. Each message describes its own layout.
"""

from typing import Any

import numpy as np
from jaxtyping import UInt8

from sglpr_jax.data.formats.bin_records import Records
from sglpr_jax.data.formats.scan_size import check_points
from sglpr_jax.data.point_times import FIELDS, TimeField, time_field_of
from sglpr_jax.data.warning import warn

_TYPES = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 8: "f8"}
_LEAST_M, _MOST_M = 1e-3, 1e4
"""Range of most nonzero coordinates, in metres. Numbers in the other byte order are spread over 10**-38 to 10**38."""
_LASERS = ("ring", "channel", "line", "laser_id", "laser")
"""Field names that drivers use for the laser number of a point."""


def read_point_cloud2(message: Any, *, name: str = "cloud") -> Records:
    """Return the points (n, 3) in the axes of the message, and their lasers and times if the message has such fields.

    Some drivers set `is_bigendian` for little-endian data. If only the little-endian numbers are metres, they are
    returned, with a warning.

    Arguments:
      message: Object with the attributes of sensor_msgs/PointCloud2.
      name: Name of the message for the warning.

    Raises:
      ValueError: If x, y or z is missing or not numeric, or the data is shorter than its width, height and steps
        require.
    """
    data = _point_bytes(message)
    records = data.view(_record(message, ">" if message.is_bigendian else "<"))
    if message.is_bigendian and not _in_metres(records):
        others = data.view(_record(message, "<"))
        if _in_metres(others):
            warn(f"{name}: expected big-endian points, as is_bigendian states, found little-endian points")
            records = others
    names = records.dtype.names or ()
    laser, time = next((field for field in _LASERS if field in names), None), time_field_of(names)
    times = None if time is None else TimeField(time, records[time].copy())
    with np.errstate(over="ignore", invalid="ignore"):
        points = np.stack([records[axis] for axis in "xyz"], axis=1).astype(np.float32)
        return Records(points, None if laser is None else records[laser].astype(np.int32), times)


def described_fields(message: Any) -> str:
    """Return a description of the fields of a cloud: "x y z intensity ring (22 bytes a point)"."""
    return f"{' '.join(field.name for field in message.fields)} ({message.point_step} bytes a point)"


def _point_bytes(message: Any) -> UInt8[np.ndarray, " n"]:
    """Bytes of all points, without the padding of rows."""
    width, height, step, row = message.width, message.height, message.point_step, message.row_step
    check_points(width * height, bytes_each=step)
    row = max(row, width * step)
    data = np.frombuffer(bytes(message.data), np.uint8)
    if not step or len(data) < row * (height - 1) + width * step:
        raise ValueError(f"expected {height} rows of {width} points of {step} bytes, found {len(data)} bytes")
    return np.concatenate([data[start : start + width * step] for start in range(0, row * height, row)])


def _in_metres(records: np.ndarray) -> bool:
    """Whether most coordinates are those of a scan. Zeros and NaN are ignored."""
    size = np.abs(np.stack([records[axis].astype(np.float64) for axis in "xyz"]))
    size = size[size > 0]
    return not size.size or bool(np.mean((size >= _LEAST_M) & (size <= _MOST_M)) > 0.5)


def _record(message: Any, order: str) -> np.dtype:
    fields = {field.name: field for field in message.fields}
    if not {"x", "y", "z"} <= set(fields):
        raise ValueError(f"expected the fields x, y and z, found {' '.join(fields) or 'none'}")
    wanted = [name for name in ("x", "y", "z", *_LASERS) if name in fields]
    wanted += [name for name in FIELDS if name in fields and fields[name].datatype in _TYPES]
    types = [_TYPES.get(fields[name].datatype) for name in wanted]
    if None in types:
        raise ValueError(f"expected numbers of types 1 to 8, found {[fields[name].datatype for name in wanted]}")
    try:
        return np.dtype(
            {
                "names": wanted,
                "formats": [f"{order}{kind}" for kind in types],
                "offsets": [fields[name].offset for name in wanted],
                "itemsize": message.point_step,
            }
        )
    except (ValueError, OverflowError) as error:
        raise ValueError(f"expected fields within {message.point_step} bytes, found others ({error})") from error
