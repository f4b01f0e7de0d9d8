"""Reads sensor_msgs/PointCloud2 messages of ROS, with any field layout, either byte order, and padded rows.

The drivers of Velodyne, Ouster, Hesai and Livox use different layouts. Each message describes its own layout.
"""

from typing import Any

import numpy as np

from sglpr_jax.data.formats.bin_records import Records

_TYPES = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 8: "f8"}
_LASERS = ("ring", "channel", "line", "laser_id", "laser")
"""Field names that drivers use for the laser number of a point."""


def read_point_cloud2(message: Any) -> Records:
    """Return the points (n, 3) in the axes of the message, and their lasers if the message has a laser field.

    Arguments:
      message: Object with the attributes of sensor_msgs/PointCloud2.

    Raises:
      ValueError: If x, y or z is missing or not numeric, or the data is shorter than its width, height and steps
        require.
    """
    records = _records(message)
    names = records.dtype.names or ()
    with np.errstate(over="ignore", invalid="ignore"):
        points = np.stack([records[axis] for axis in "xyz"], axis=1).astype(np.float32)
    laser = next((name for name in _LASERS if name in names), None)
    return Records(points, None if laser is None else records[laser].astype(np.int32))


def described_fields(message: Any) -> str:
    """Return a description of the fields of a cloud: "x y z intensity ring (22 bytes a point)"."""
    return f"{' '.join(field.name for field in message.fields)} ({message.point_step} bytes a point)"


def _records(message: Any) -> np.ndarray:
    """Points as a numpy array of records, without the padding of rows."""
    width, height, step, row = message.width, message.height, message.point_step, message.row_step
    if width * height == 0:
        raise ValueError("expected at least one point, found none")
    row = max(row, width * step)
    data = np.frombuffer(bytes(message.data), np.uint8)
    if len(data) < row * (height - 1) + width * step:
        raise ValueError(f"expected {height} rows of {width} points of {step} bytes, found {len(data)} bytes")
    rows = [data[start : start + width * step] for start in range(0, row * height, row)]
    return np.concatenate(rows).view(_record(message))


def _record(message: Any) -> np.dtype:
    order = ">" if message.is_bigendian else "<"
    fields = {field.name: field for field in message.fields}
    if not {"x", "y", "z"} <= set(fields):
        raise ValueError(f"expected the fields x, y and z, found {' '.join(fields) or 'none'}")
    wanted = [name for name in ("x", "y", "z", *_LASERS) if name in fields]
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
    except ValueError as error:
        raise ValueError(f"expected fields within {message.point_step} bytes, found others ({error})") from error
