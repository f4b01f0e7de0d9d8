"""Sequences of HeLiPR: four LiDARs on a car, each a recording of its own.

    Roundabout01/LiDAR/Ouster/1689519060427055360.bin   scans; the number is the time in nanoseconds
    Roundabout01/LiDAR_GT/Ouster_gt.txt                 time x y z qx qy qz qw of that sensor: east, north, up

The points of each sensor are packed in a way of its own, without padding; axes stay as they are.
"""

from functools import partial
from pathlib import Path

import numpy as np

from sglpr_jax.data.formats.bin_records import Records
from sglpr_jax.data.reader import Reader
from sglpr_jax.data.readers.stamped import read_table, stamped_recording
from sglpr_jax.data.recording import Recording

RECORDS = {
    "Avia": np.dtype([("xyz", "<f4", 3), ("reflectivity", "u1"), ("tag", "u1"), ("line", "u1"), ("offset", "<u4")]),
    "Aeva": np.dtype([("xyz", "<f4", 3), ("more", "<f4", 2), ("offset", "<i4"), ("line", "u1"), ("intensity", "<f4")]),
    "Ouster": np.dtype(
        [("xyz", "<f4", 3), ("intensity", "<f4"), ("t", "<u4"), ("reflectivity", "<u2"), ("line", "<u2"), ("a", "<u2")]
    ),
    "Velodyne": np.dtype([("xyz", "<f4", 3), ("intensity", "<f4"), ("line", "<u2"), ("time", "<f4")]),
}
"""The points of each sensor."""
AEVA_BEFORE = np.dtype([("xyz", "<f4", 3), ("more", "<f4", 2), ("offset", "<i4"), ("line", "u1")])
AEVA_CHANGED = 1691936557946849179
"""Aeva's scans up to this time have no intensities."""


def recording_names(root: Path) -> tuple[str, ...]:
    """Return SEQUENCE-SENSOR for each sensor with scans in `root`, which holds sequences or is one."""
    itself = {root.resolve().name: root} if (root / "LiDAR").is_dir() else {}
    folders = itself or {path.parent.name: path.parent for path in sorted(root.glob("*/LiDAR"))}
    return tuple(
        f"{sequence}-{sensor}"
        for sequence, folder in folders.items()
        for sensor in RECORDS
        if (folder / "LiDAR" / sensor).is_dir() and (folder / "LiDAR_GT" / f"{sensor}_gt.txt").is_file()
    )


def open_recording(root: Path, name: str) -> Recording:
    """Open what one sensor saw of a sequence; see `stamped_recording` for the errors."""
    sequence, _, sensor = name.rpartition("-")
    folder = root if (root / "LiDAR").is_dir() else root / sequence
    poses = folder / "LiDAR_GT" / f"{sensor}_gt.txt"
    stamps, numbers = read_table(poses, columns=8)
    return stamped_recording(
        folder / "LiDAR" / sensor,
        name,
        stamps=stamps,
        positions=numbers[:, :3],
        pose_file=poses,
        tick_s=1e-9,
        read_points=partial(read_points, sensor=sensor),
        format=f"HeLiPR's {sensor} ({RECORDS[sensor].itemsize} bytes a point)",
    )


def read_points(path: Path, *, sensor: str) -> Records:
    """Read a scan and the lines of its points. ValueError where its size is no whole number of points."""
    before = sensor == "Aeva" and int(path.stem) <= AEVA_CHANGED
    record = AEVA_BEFORE if before else RECORDS[sensor]
    size = path.stat().st_size
    if size == 0 or size % record.itemsize:
        raise ValueError(f"{path}: expected {record.itemsize} bytes a point ({sensor}), found {size} bytes in all")
    found = np.fromfile(path, record)
    return Records(np.ascontiguousarray(found["xyz"], np.float32), found["line"].astype(np.int32))


READER = Reader(
    layout="NAME/LiDAR/SENSOR/*.bin with NAME/LiDAR_GT/SENSOR_gt.txt (HeLiPR)",
    recording_names=recording_names,
    open=lambda root, name, options: open_recording(root, name),
    knows_mounting=False,
    rank=4,
)
