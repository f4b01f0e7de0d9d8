"""Point clouds for the tests: messages as the drivers of sensors write them, and files of every format."""

import io
from collections.abc import Callable
from types import SimpleNamespace

import laspy
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


def records_of(points: np.ndarray, kinds: str = "x:f4 y:f4 z:f4 i:f4", **more: np.ndarray) -> np.ndarray:
    """Records with the points and more columns, in the order of `kinds`. Columns without values are zeros."""
    found = np.zeros(len(points), [tuple(kind.split(":")) for kind in kinds.split()])
    for name, column in {**dict(zip("xyz", points.T, strict=False)), **more}.items():
        found[name] = column
    return found


def text(records: np.ndarray) -> bytes:
    """Records, one a line."""
    return "".join(" ".join(f"{value:.17g}" for value in row) + "\n" for row in records.tolist()).encode()


def literals(data: bytes) -> bytes:
    """LZF data without references."""
    runs = [data[start : start + 32] for start in range(0, len(data), 32)]
    return b"".join(bytes([len(run) - 1]) + run for run in runs)


def pcd(records: np.ndarray, data: str = "binary", **changed: str | int) -> bytes:
    """Records as a .pcd file. Some lines of its header may be changed."""
    kinds = [records.dtype[name] for name in records.dtype.names]
    lines = {
        "VERSION": "0.7",
        "FIELDS": " ".join(records.dtype.names),
        "SIZE": " ".join(str(kind.itemsize) for kind in kinds),
        "TYPE": " ".join(kind.kind.upper() for kind in kinds),
        "COUNT": " ".join("1" for _ in kinds),
        "WIDTH": len(records),
        "HEIGHT": 1,
        "POINTS": len(records),
        "DATA": data,
    }
    columns = b"".join(records[name].tobytes() for name in records.dtype.names)
    packed = literals(columns)
    sizes = np.array([len(packed), len(columns)], "<u4").tobytes()
    body = {"binary": records.tobytes(), "binary_compressed": sizes + packed, "ascii": text(records)}
    header = "".join(f"{word} {value}\n" for word, value in {**lines, **changed}.items())
    return f"# .PCD v0.7\n{header}".encode() + body.get(data, b"")


PLY_TYPES = {"f4": "float", "f8": "double", "u1": "uchar", "u2": "ushort", "u4": "uint"}
PLY_ORDERS = {"": "ascii", "<": "binary_little_endian", ">": "binary_big_endian"}


def ply(records: np.ndarray, order: str = "", *, before: str = "", front: bytes = b"", after: str = "") -> bytes:
    """Records as a .ply file: in text, or in one of two byte orders, with elements before and after the vertices."""
    names = records.dtype.names
    properties = "".join(f"property {PLY_TYPES[records.dtype[name].str[1:]]} {name}\n" for name in names)
    header = f"ply\nformat {PLY_ORDERS[order]} 1.0\ncomment made by a test\n{before}element vertex {len(records)}\n"
    body = records.astype(records.dtype.newbyteorder(order)).tobytes() if order else text(records)
    return f"{header}{properties}{after}end_header\n".encode() + front + body


def las(points: np.ndarray, *, version: str = "1.2", offsets: tuple[float, ...] = (0, 0, 0)) -> bytes:
    """Points as a .las file."""
    cloud = laspy.LasData(laspy.LasHeader(point_format=6 if version == "1.4" else 3, version=version))
    cloud.header.scales, cloud.header.offsets = [0.001] * 3, offsets
    cloud.x, cloud.y, cloud.z = points[:, :3].astype(np.float64).T
    return stream_of(cloud.write)


def stream_of(save: Callable[..., object], *arguments: object, **named: object) -> bytes:
    """Bytes that a function writes into a stream, its first argument."""
    stream = io.BytesIO()
    save(stream, *arguments, **named)
    return stream.getvalue()


def street(seed: int, *, height_m: float) -> np.ndarray:
    """Ground and walls around an upright sensor."""
    rng = np.random.default_rng(seed)
    ground = np.column_stack([rng.uniform(-15, 15, (1500, 2)), rng.normal(scale=0.02, size=1500)])
    walls = np.column_stack([rng.uniform(-20, 20, 700), rng.choice([-9.0, 8.0], 700), rng.uniform(0, 9, 700)])
    return np.concatenate([ground, walls])[rng.permutation(2200)] - [0, 0, height_m]
