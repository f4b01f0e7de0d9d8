"""Messages with points as the drivers of sensors write them."""

from types import SimpleNamespace

import numpy as np

CODES = {"i1": 1, "u1": 2, "i2": 3, "u2": 4, "i4": 5, "u4": 6, "f4": 7, "f8": 8}
DRIVERS = {
    "velodyne": (22, {"x": (0, "f4"), "y": (4, "f4"), "z": (8, "f4"), "intensity": (12, "f4"), "ring": (16, "u2")}),
    "velodyne, padded": (32, {"x": (0, "f4"), "y": (4, "f4"), "z": (8, "f4"), "ring": (20, "u2"), "time": (24, "f4")}),
    "ouster": (
        48,
        {"x": (0, "f4"), "y": (4, "f4"), "z": (8, "f4"), "intensity": (16, "f4"), "t": (20, "u4"), "ring": (26, "u1")},
    ),
    "hesai": (
        34,
        {"x": (0, "f4"), "y": (4, "f4"), "z": (8, "f4"), "timestamp": (18, "f8"), "ring": (26, "u2")},
    ),
    "livox": (26, {"x": (0, "f4"), "y": (4, "f4"), "z": (8, "f4"), "tag": (16, "u1"), "line": (17, "u1")}),
    "turned about": (41, {"ring": (0, "u1"), "z": (1, "f8"), "x": (17, "f8"), "y": (33, "f8")}),
}


def cloud(points, driver="velodyne", *, order="<", height=1, padding=0):
    """What a message holds: the points as this driver lays them out, in `height` rows, each followed by padding."""
    step, layout = DRIVERS[driver]
    kinds = {"names": list(layout), "formats": [order + kind for _, kind in layout.values()]}
    records = np.full(len(points) * step, 0xAB, np.uint8).view(
        np.dtype({**kinds, "offsets": [offset for offset, _ in layout.values()], "itemsize": step})
    )
    for axis, column in zip("xyz", points.T, strict=True):
        records[axis] = column
    laser = "line" if driver == "livox" else "ring"
    records[laser] = np.arange(len(points)) % 16
    rows = np.frombuffer(records.tobytes(), np.uint8).reshape(height, -1)
    rows = np.pad(rows, ((0, 0), (0, padding)), constant_values=0xCD)
    return SimpleNamespace(
        fields=[SimpleNamespace(name=n, offset=o, datatype=CODES[k], count=1) for n, (o, k) in layout.items()],
        is_bigendian=order == ">",
        point_step=step,
        row_step=rows.shape[1],
        width=len(points) // height,
        height=height,
        data=rows.reshape(-1),
    )


def points_of(scan: int, n: int = 24) -> np.ndarray:
    points = np.random.default_rng(scan).normal(scale=9, size=(n, 3)).astype(np.float32)
    points[3] = np.nan
    return points
