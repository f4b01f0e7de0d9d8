"""Reader of MulRan, HeLiPR and Boreas: scans that are named by their time, and a table of poses with other times.

- MulRan, an Ouster OS1-64: `KAIST01/Ouster/1561000444390857630.bin`, float32 x, y, z, intensity; `global_pose.csv`:
  time and 12 numbers (world_from_base, in axes east, north, up). The Ouster is rotated by 180 degrees about z relative
  to the car (179.67 degrees by its calibration). The points are rotated so that x points forward.
- HeLiPR, four LiDARs, each a recording: `Roundabout01/LiDAR/Ouster/1689519060427055360.bin`, in a record of its own
  without padding; `LiDAR_GT/Ouster_gt.txt`: time x y z qx qy qz qw of that sensor, in axes east, north, up.
- Boreas, a Velodyne Alpha Prime: `boreas-2020-12-01-13-26/lidar/1606847163437292.bin`, float32 x, y, z, intensity,
  laser, time; `applanix/lidar_poses.csv`: GPSTime, easting, northing, altitude and nine other columns.

Names and times of MulRan and HeLiPR are in nanoseconds, those of Boreas in microseconds. Positions are those of the
LiDAR. A new layout of this kind is one more row of `LAYOUTS`.
"""

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, Int64

from sglpr_jax.data.formats.bin_records import described, read_record_file, read_records
from sglpr_jax.data.formats.pose_files import read_stamped_rows
from sglpr_jax.data.readers.listing import scans_in
from sglpr_jax.data.readers.reader import Reader, ReadOptions
from sglpr_jax.data.recording import Recording
from sglpr_jax.data.scan import Scan
from sglpr_jax.data.times import check_unit, nearest_rows

MAX_GAP_S = 0.1
"""Maximum time between a scan and its pose, in seconds: the duration of one sweep."""
OUSTER_IN_BASE_M = np.array([1.7042, -0.021, 1.8047])
"""Position of MulRan's Ouster in the car's frame by the dataset's calibration, in metres."""
FORWARD_FROM_OUSTER = np.array([-1, -1, 1], np.float32)
HELIPR = {
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
BOREAS = np.dtype([("xyz", "<f4", 3), ("more", "<f4", 2), ("time", "<f4")])
AEVA_BEFORE = np.dtype([("xyz", "<f4", 3), ("more", "<f4", 2), ("offset_time", "<i4"), ("line", "u1")])
AEVA_CHANGED = 1691936557946849179
"""Time in nanoseconds. Aeva scans up to this time have no intensities (`AEVA_BEFORE`)."""


def read_helipr(path: Path, *, sensor: str) -> Scan:
    """Read the points of a scan, their line numbers and their times."""
    before = sensor == "Aeva" and int(path.stem) <= AEVA_CHANGED
    return read_record_file(path, AEVA_BEFORE if before else HELIPR[sensor], format=sensor)


def _ouster_positions(numbers: Float[np.ndarray, "n 12"]) -> Float[np.ndarray, "n 3"]:
    world_from_base = numbers.reshape(-1, 3, 4)
    return world_from_base[:, :, :3] @ OUSTER_IN_BASE_M + world_from_base[:, :, 3]


class Layout(NamedTuple):
    """Files of a sequence, and how they are read."""

    scans: str
    """Folder of the scans."""
    poses: str
    columns: int
    """Number of columns of the table of poses."""
    tick_s: float
    """Unit of the names and times, in seconds."""
    read: Callable[[Path], Scan]
    found: str
    """Format in words."""
    positions: Callable[[np.ndarray], np.ndarray] = lambda numbers: numbers[:, :3]
    """Returns positions of the LiDAR by the columns after the time."""
    header_lines: int = 0
    suffix: str = ""
    """End of the name of the recording, after that of the sequence."""


LAYOUTS: dict[str, tuple[Layout, ...]] = {
    "mulran": (
        Layout(
            "Ouster",
            "global_pose.csv",
            13,
            1e-9,
            lambda path: Scan(points=read_records(path, "kitti").cloud * FORWARD_FROM_OUSTER),
            f"MulRan, {described('kitti')}, rotated to x forward",
            _ouster_positions,
        ),
    ),
    "helipr": tuple(
        Layout(
            f"LiDAR/{sensor}",
            f"LiDAR_GT/{sensor}_gt.txt",
            8,
            1e-9,
            partial(read_helipr, sensor=sensor),
            f"HeLiPR's {sensor} ({record.itemsize} bytes a point)",
            suffix=f"-{sensor}",
        )
        for sensor, record in HELIPR.items()
    ),
    "boreas": (
        Layout(
            "lidar",
            "applanix/lidar_poses.csv",
            13,
            1e-6,
            partial(read_record_file, record=BOREAS, format="float32x6"),
            f"Boreas, {described('float32x6')}",
            header_lines=1,
        ),
    ),
}
"""Layouts of the sequences of each dataset."""


def _recordings(root: Path, dataset: str) -> dict[str, tuple[Path, Layout]]:
    """Folder and layout of each recording by name: those in `root`, or `root` itself if it is a sequence."""
    found = {}
    for layout in LAYOUTS[dataset]:
        for folder in (root, *(sorted(root.glob("*")) if root.is_dir() else ())):
            if (folder / layout.scans).is_dir() and (folder / layout.poses).is_file():
                found[f"{folder.resolve().name}{layout.suffix}"] = folder, layout
    return dict(sorted(found.items(), key=lambda one: one[1][0].name))


def recording_names(root: Path, *, dataset: str) -> tuple[str, ...]:
    """Return the names of the recordings in `root`. `root` may be a sequence itself."""
    return tuple(_recordings(root, dataset))


def open_recording(root: Path, name: str, options: ReadOptions, *, dataset: str) -> Recording:
    """Open a recording."""
    folder, layout = _recordings(root, dataset)[name]
    poses = folder / layout.poses
    stamps, numbers = read_stamped_rows(poses, columns=layout.columns, header_lines=layout.header_lines)
    return stamped_recording(
        folder / layout.scans,
        name,
        stamps=stamps,
        positions=np.ascontiguousarray(layout.positions(numbers)),
        pose_file=poses,
        tick_s=layout.tick_s,
        read_points=layout.read,
        found=(f"format: {layout.found}",),
    )


def stamped_recording(
    folder: Path,
    name: str,
    *,
    stamps: Int64[np.ndarray, " n"],
    positions: Float[np.ndarray, "n 3"],
    pose_file: Path,
    tick_s: float,
    read_points: Callable[[Path], Scan],
    max_gap_s: float = MAX_GAP_S,
    **fields: Any,
) -> Recording:
    """Open the `.bin` files of a folder, which are named by their time in ticks, each with the nearest pose in time.

    Arguments:
      folder: Folder of the scans.
      name: Name of the recording.
      stamps: Time of each pose, in ticks.
      positions: Position of each pose, in metres.
      pose_file: Pose file, for messages.
      tick_s: Duration of a tick, in seconds.
      read_points: Function that reads a scan.
      max_gap_s: Maximum time between a scan and its pose, in seconds. Other scans are skipped.
      fields: More fields of the recording.
    """
    paths = scans_in(folder, ".bin")
    strange = next((path.name for path in paths if not path.stem.isdecimal()), None)
    if strange:
        raise ValueError(f"{folder}: expected scans named by their time, as 1561000444390857630.bin, found {strange}")
    times = np.array([int(path.stem) for path in paths], np.int64)
    order = np.argsort(stamps, kind="stable")
    check_unit(stamps[order] * tick_s, source=pose_file)
    check_unit(times * tick_s, source=folder)
    nearest = order[nearest_rows(stamps[order], times)]
    gaps_s = np.abs(stamps[nearest] - times) * tick_s
    rows = np.flatnonzero(gaps_s <= max_gap_s)
    if not len(rows):
        raise ValueError(
            f"{pose_file}: expected poses within {max_gap_s:g} s of the scans in {folder}, found the nearest "
            f"{gaps_s.min():g} s away"
        )
    left_out = len(paths) - len(rows)
    said = f" ({left_out} of {len(paths)} scans left out: no pose within {max_gap_s:g} s)" if left_out else ""
    return Recording(
        name=name,
        ids=tuple(paths[row].stem for row in rows),
        paths=tuple(paths[row] for row in rows),
        read=lambda path, labels, lasers: read_points(path),
        positions=positions[nearest[rows]],
        times=times[rows] * tick_s,
        pose_source=f"{pose_file.name}{said}",
        rows=rows,
        **fields,
    )


READERS = tuple(
    Reader(
        layout,
        partial(recording_names, dataset=dataset),
        partial(open_recording, dataset=dataset),
        knows_mounting=False,
        rank=rank,
    )
    for rank, (dataset, layout) in enumerate(
        {
            "mulran": "NAME/Ouster/*.bin with NAME/global_pose.csv (MulRan)",
            "helipr": "NAME/LiDAR/SENSOR/*.bin with NAME/LiDAR_GT/SENSOR_gt.txt (HeLiPR)",
            "boreas": "NAME/lidar/*.bin with NAME/applanix/lidar_poses.csv (Boreas)",
        }.items(),
        start=3,
    )
)
