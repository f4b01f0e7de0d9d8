"""Reader of HeLiPR: four LiDARs on a car. Each LiDAR is a separate recording.

- `Roundabout01/LiDAR/Ouster/1689519060427055360.bin`: a scan, named by its time in nanoseconds.
- `Roundabout01/LiDAR_GT/Ouster_gt.txt`: time x y z qx qy qz qw of that sensor, in axes east, north, up.

Each sensor has its own record format, without padding. The axes of the points are not changed.
"""

from functools import partial
from pathlib import Path

import numpy as np

from sglpr_jax.data.readers.reader import Reader, ReadOptions
from sglpr_jax.data.readers.stamped import read_table, sequences, stamped_recording
from sglpr_jax.data.record import Record, TimeField, time_field_of
from sglpr_jax.data.recording import Recording

RECORDS = {
    "Avia": np.dtype(
        [("xyz", "<f4", 3), ("reflectivity", "u1"), ("tag", "u1"), ("line", "u1"), ("offset_time", "<u4")]
    ),
    "Aeva": np.dtype(
        [("xyz", "<f4", 3), ("more", "<f4", 2), ("offset_time", "<i4"), ("line", "u1"), ("intensity", "<f4")]
    ),
    "Ouster": np.dtype(
        [("xyz", "<f4", 3), ("intensity", "<f4"), ("t", "<u4"), ("reflectivity", "<u2"), ("line", "<u2"), ("a", "<u2")]
    ),
    "Velodyne": np.dtype([("xyz", "<f4", 3), ("intensity", "<f4"), ("line", "<u2"), ("time", "<f4")]),
}
"""Record of one point, for each sensor."""
AEVA_BEFORE = np.dtype([("xyz", "<f4", 3), ("more", "<f4", 2), ("offset_time", "<i4"), ("line", "u1")])
AEVA_CHANGED = 1691936557946849179
"""Time in nanoseconds. Aeva scans up to this time have no intensities (`AEVA_BEFORE`)."""


def recording_names(root: Path) -> tuple[str, ...]:
    """Return SEQUENCE-SENSOR for each sensor with scans and poses. `root` holds sequences or is a sequence itself."""
    return tuple(
        f"{sequence}-{sensor}"
        for sequence, folder in sequences(root, "LiDAR").items()
        for sensor in RECORDS
        if (folder / "LiDAR" / sensor).is_dir() and (folder / "LiDAR_GT" / f"{sensor}_gt.txt").is_file()
    )


def open_recording(root: Path, name: str, options: ReadOptions) -> Recording:
    """Open the scans of one sensor in a sequence. Raises what `stamped_recording` and `read_table` raise."""
    sequence, _, sensor = name.rpartition("-")
    folder = sequences(root, "LiDAR")[sequence]
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
        found=(f"format: HeLiPR's {sensor} ({RECORDS[sensor].itemsize} bytes a point)",),
    )


def read_points(path: Path, *, sensor: str) -> Record:
    """Read the points of a scan, their line numbers and their times. Raises ValueError if the file has a wrong size."""
    before = sensor == "Aeva" and int(path.stem) <= AEVA_CHANGED
    record = AEVA_BEFORE if before else RECORDS[sensor]
    size = path.stat().st_size
    if size == 0 or size % record.itemsize:
        raise ValueError(f"{path}: expected {record.itemsize} bytes a point ({sensor}), found {size} bytes in total")
    found = np.fromfile(path, record)
    time = time_field_of(record.names or ())
    times = None if time is None else TimeField(time, found[time].copy())
    lasers = found["line"].astype(np.int32)
    return Record(points=np.ascontiguousarray(found["xyz"], np.float32), lasers=lasers, time_field=times)


READER = Reader(
    "NAME/LiDAR/SENSOR/*.bin with NAME/LiDAR_GT/SENSOR_gt.txt (HeLiPR)",
    recording_names,
    open_recording,
    knows_mounting=False,
    rank=4,
)
