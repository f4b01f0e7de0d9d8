"""Readers of MulRan, HeLiPR, Boreas and NCLT: scans named by their time, and a table of poses at other times.

- NCLT: `2012-01-15/velodyne_sync/1326652795280148.bin`, in a record of its own; `groundtruth_2012-01-15.csv`, also in
  the date's folder or in `ground_truth/`: utime, x, y, z, roll, pitch, yaw of the body. World axes are north, east,
  down with one origin for all sessions, body axes forward, right, down with the origin on the ground. The scans are
  already in the body frame. The reader turns both frames by 180 degrees about x: positions are north, west, up.
- MulRan, an Ouster OS1-64: `KAIST01/Ouster/1561000444390857630.bin`, float32 x, y, z, intensity; `global_pose.csv`:
  time and 12 numbers (world_from_base, in axes east, north, up). The Ouster is rotated by 180 degrees about z relative
  to the car (179.67 degrees by its calibration). The points are rotated so that x points forward.
- HeLiPR, four LiDARs, each a recording: `Roundabout01/LiDAR/Ouster/1689519060427055360.bin`, in a record of its own
  without padding; `LiDAR_GT/Ouster_gt.txt`: time x y z qx qy qz qw of that sensor, in axes east, north, up.
- Boreas, a Velodyne Alpha Prime: `boreas-2020-12-01-13-26/lidar/1606847163437292.bin`, float32 x, y, z, intensity,
  laser, time; `applanix/lidar_poses.csv`: GPSTime, easting, northing, altitude and nine other columns.

Names and times of MulRan and HeLiPR are in nanoseconds, the others in microseconds. Except for NCLT, positions are
those of the LiDAR. To support another dataset with such files, add an entry to `LAYOUTS`.
"""

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int64

from sglpr_jax.data.formats.bin_records import Z_UP_FROM_Z_DOWN, describe_format, read_record_file, read_records
from sglpr_jax.data.formats.pose_files import read_timed_rows
from sglpr_jax.data.mounting import Mounting
from sglpr_jax.data.readers.listing import scans_in
from sglpr_jax.data.readers.reader import Reader, ReadOptions
from sglpr_jax.data.recording import Recording
from sglpr_jax.data.scan import Scan
from sglpr_jax.data.times import check_order, check_unit, nearest_rows

StampedPositions = tuple[Int64[np.ndarray, " n"], Float[np.ndarray, "n 3"]]
"""Times in the unit of the dataset (`Layout.time_unit_s`), and positions in metres, z up."""
OUSTER_IN_BASE_M = np.array([1.7042, -0.021, 1.8047])
"""Position of MulRan's Ouster in the car's frame by the dataset's calibration, in metres."""
FORWARD_FROM_OUSTER = np.array([-1, -1, 1], np.float32)
"""Rotation by 180 degrees about z, as factors of x, y and z."""


def _record(fields: str) -> np.dtype:
    """Return the numpy type of a point: float32 x, y, z, and fields such as "line u1, time f4"; no padding."""
    names_and_types = [field.split() for field in fields.split(",")]
    return np.dtype([("xyz", "<f4", 3), *((name, f"<{kind}") for name, kind in names_and_types)])  # little-endian


BOREAS = _record("intensity f4, ring f4, time f4")
HELIPR = {
    "Avia": _record("reflectivity u1, tag u1, line u1, offset_time u4"),
    "Aeva": _record("reflectivity f4, velocity f4, offset_time i4, line u1, intensity f4"),
    "Ouster": _record("intensity f4, t u4, reflectivity u2, line u2, ambient u2"),
    "Velodyne": _record("intensity f4, line u2, time f4"),
}
"""Record of one point, for each sensor of HeLiPR."""
AEVA_WITHOUT_INTENSITY = _record("reflectivity f4, velocity f4, offset_time i4, line u1")
AEVA_CHANGED = 1691936557946849179
"""Time in nanoseconds. Aeva scans up to this time have the record `AEVA_WITHOUT_INTENSITY`."""


def read_nclt_poses(path: Path) -> StampedPositions:
    """Return times (us) and positions of an NCLT session: utime, x, y, z, roll, pitch, yaw. Drops rows with NaN."""
    times, poses = read_timed_rows(path, columns=7, finite=False)
    is_known = np.isfinite(poses).all(axis=1)
    if not is_known.any():
        raise ValueError(f"{path}: expected poses, found NaN in all {len(poses)} rows")
    check_order(times[is_known] * 1e-6, source=path)
    return times[is_known], poses[is_known, :3] * Z_UP_FROM_Z_DOWN


def read_mulran_poses(path: Path) -> StampedPositions:
    """Read the poses of MulRan's car (time and 12 numbers), and return the positions of its Ouster."""
    times, rows = read_timed_rows(path, columns=13)
    world_from_base = rows.reshape(-1, 3, 4)
    return times, world_from_base[:, :, :3] @ OUSTER_IN_BASE_M + world_from_base[:, :, 3]


def read_positions(path: Path, *, columns: int, header_lines: int = 0) -> StampedPositions:
    """Return the times (first column) and positions (second to fourth column) of a table of LiDAR poses."""
    times, rows = read_timed_rows(path, columns=columns, header_lines=header_lines)
    return times, np.ascontiguousarray(rows[:, :3])


def read_helipr(path: Path, *, sensor: str) -> Scan:
    """Read a scan of a HeLiPR sensor ("Avia", "Aeva", ...) with laser numbers and times of its points."""
    has_old_record = sensor == "Aeva" and int(path.stem) <= AEVA_CHANGED  # the file name is the time
    return read_record_file(path, AEVA_WITHOUT_INTENSITY if has_old_record else HELIPR[sensor], format=sensor)


class Layout(NamedTuple):
    """Location of the files of one sequence or sensor, and the functions that read them."""

    scans: str
    """Folder of the scans, relative to the folder of the sequence."""
    poses: tuple[str, ...]
    """Possible paths of the pose file. `{}` stands for the name of the sequence."""
    time_unit_s: float
    """Unit of scan names and pose times, in seconds: 1e-9 for nanoseconds."""
    read_scan: Callable[[Path], Scan]
    read_poses: Callable[[Path], StampedPositions]
    description: str
    """Description of the format for the user."""
    world: str
    """Name of the dataset, whose sequences have one frame (`Recording.world`)."""
    suffix: str = ""
    """Suffix that is appended to the name of the sequence to form the name of the recording: "-Ouster"."""
    folders: str = "*"
    """Pattern of the names of sequences. With "*", only folders with a pose file are sequences."""
    max_gap_s: float = 0.1
    """Maximum time between a scan and its pose, in seconds, by default the duration of one sweep."""
    mounting: Mounting | None = None
    """Mounting of the frame of the points, if the dataset defines it."""

    def pose_file(self, folder: Path) -> Path | None:
        """Return the pose file of the sequence in a folder, or None if no file of `poses` exists."""
        candidates = [folder / path.format(folder.resolve().name) for path in self.poses]
        return next((path for path in candidates if path.is_file()), None)

    def sequences(self, root: Path) -> tuple[Path, ...]:
        """Return the folders of the sequences in `root`, which may be a sequence itself."""
        folders = [folder for folder in (root, *sorted(root.glob(self.folders))) if (folder / self.scans).is_dir()]
        if self.folders == "*":
            folders = [folder for folder in folders if self.pose_file(folder) is not None]
        return tuple(folders)


LAYOUTS: dict[str, tuple[Layout, ...]] = {
    "YYYY-MM-DD/velodyne_sync/*.bin (NCLT)": (
        Layout(
            scans="velodyne_sync",
            poses=("../groundtruth_{}.csv", "groundtruth_{}.csv", "../ground_truth/groundtruth_{}.csv"),
            time_unit_s=1e-6,
            read_scan=partial(read_records, format="nclt"),
            read_poses=read_nclt_poses,
            description="sensor: coordinates are relative to the ground below it",
            world="NCLT",
            folders="[0-9][0-9][0-9][0-9]-[0-9][0-9]-[0-9][0-9]",
            max_gap_s=0.5,  # a Segway moves half a metre in this time
            mounting=Mounting(0.0),
        ),
    ),
    "NAME/Ouster/*.bin with NAME/global_pose.csv (MulRan)": (
        Layout(
            scans="Ouster",
            poses=("global_pose.csv",),
            time_unit_s=1e-9,
            read_scan=lambda path: Scan(points=read_records(path, "kitti").cloud * FORWARD_FROM_OUSTER),
            read_poses=read_mulran_poses,
            description=f"format: MulRan, {describe_format('kitti')}, rotated to x forward",
            world="MulRan",
        ),
    ),
    "NAME/LiDAR/SENSOR/*.bin with NAME/LiDAR_GT/SENSOR_gt.txt (HeLiPR)": tuple(
        Layout(
            scans=f"LiDAR/{sensor}",
            poses=(f"LiDAR_GT/{sensor}_gt.txt",),
            time_unit_s=1e-9,
            read_scan=partial(read_helipr, sensor=sensor),
            read_poses=partial(read_positions, columns=8),
            description=f"format: HeLiPR's {sensor} ({record.itemsize} bytes a point)",
            world="HeLiPR",
            suffix=f"-{sensor}",
        )
        for sensor, record in HELIPR.items()
    ),
    "NAME/lidar/*.bin with NAME/applanix/lidar_poses.csv (Boreas)": (
        Layout(
            scans="lidar",
            poses=("applanix/lidar_poses.csv",),
            time_unit_s=1e-6,
            read_scan=partial(read_record_file, record=BOREAS, format="float32x6"),
            read_poses=partial(read_positions, columns=13, header_lines=1),
            description=f"format: Boreas, {describe_format('float32x6')}",
            world="Boreas",
        ),
    ),
}
"""Layouts of each dataset, one per sensor. The keys are shown in error messages."""


def _recordings(root: Path, layouts: tuple[Layout, ...]) -> dict[str, tuple[Path, Layout]]:
    """Return the sequence folder and the layout of each recording, by the name of the recording."""
    recordings = [(folder, layout) for layout in layouts for folder in layout.sequences(root)]
    recordings.sort(key=lambda recording: recording[0].name)
    return {f"{folder.resolve().name}{layout.suffix}": (folder, layout) for folder, layout in recordings}


def open_recording(root: Path, name: str, options: ReadOptions, *, layouts: tuple[Layout, ...]) -> Recording:
    """Open the scans with a pose within `Layout.max_gap_s`, each with the position of the nearest pose in time."""
    folder, layout = _recordings(root, layouts)[name]
    scan_folder, pose_file = folder / layout.scans, layout.pose_file(folder)
    if pose_file is None:
        expected = " or ".join(path.format(name) for path in layout.poses)
        raise FileNotFoundError(f"{folder}: expected {expected}, found none")
    pose_times, positions = layout.read_poses(pose_file)
    paths = scans_in(scan_folder, ".bin")
    misnamed = next((path.name for path in paths if not path.stem.isdecimal()), None)
    if misnamed:
        expected = "scans named by their time, as 1561000444390857630.bin"
        raise ValueError(f"{scan_folder}: expected {expected}, found {misnamed}")
    scan_times = np.array([int(path.stem) for path in paths], np.int64)
    order = np.argsort(pose_times, kind="stable")
    check_unit(pose_times[order] * layout.time_unit_s, source=pose_file)
    check_unit(scan_times * layout.time_unit_s, source=scan_folder)
    pose_rows = order[nearest_rows(pose_times[order], scan_times)]
    gaps_s = np.abs(pose_times[pose_rows] - scan_times) * layout.time_unit_s
    scan_rows = np.flatnonzero(gaps_s <= layout.max_gap_s)
    within = f"within {layout.max_gap_s:g} s"
    if not len(scan_rows):
        expected = f"poses {within} of the scans in {scan_folder}"
        raise ValueError(f"{pose_file}: expected {expected}, found the nearest {gaps_s.min():g} s away")
    missing = len(paths) - len(scan_rows)
    left_out = f" ({missing} of {len(paths)} scans left out: no pose {within})" if missing else ""
    return Recording(
        name=name,
        ids=tuple(paths[row].stem for row in scan_rows),
        paths=tuple(paths[row] for row in scan_rows),
        read=lambda path, labels: layout.read_scan(path),
        positions=positions[pose_rows[scan_rows]],
        times=scan_times[scan_rows] * layout.time_unit_s,
        pose_source=f"{pose_file.name}{left_out}",
        world=layout.world,
        rows=scan_rows,
        mounting=layout.mounting,
        found=(layout.description,),
    )


READERS = tuple(
    Reader(
        pattern,
        lambda root, layouts=layouts: tuple(_recordings(root, layouts)),
        partial(open_recording, layouts=layouts),
        knows_mounting=layouts[0].mounting is not None,
        rank=rank,
    )
    for rank, (pattern, layouts) in enumerate(LAYOUTS.items(), start=2)  # after KITTI and BEV images
)
