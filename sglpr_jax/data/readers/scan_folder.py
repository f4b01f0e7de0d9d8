"""Reader of a plain folder of scans, one file each. Poses and timestamps are optional.

- `my_scans/full0.bin`, `full1.bin`, ..., `full10.bin`: scans in the order of their numbers. Hidden files are ignored.
- `my_scans/poses.txt`: 12 numbers a line (LiDAR frame, z up) or 8 (TUM). `poses.tum` and `poses.csv` work, too.
- `my_scans/times.txt`: timestamps, one number a line, in seconds unless `time_unit` names another unit.
"""

import os
from functools import partial
from pathlib import Path

import numpy as np
from jaxtyping import Float

from sglpr_jax.data.choices import RecordFormat, ScanFormat
from sglpr_jax.data.formats.bin_records import describe_format, detect_point_format
from sglpr_jax.data.formats.pose_files import read_times, read_trajectory, warn_of_jumps
from sglpr_jax.data.formats.scan_files import (
    ARRAY_ENDINGS,
    ENDINGS,
    format_by_name,
    scan_id,
    scan_names,
    scan_of_file,
    warn_of_doubts,
)
from sglpr_jax.data.poses import poses_at_scans
from sglpr_jax.data.readers.listing import describe_contents, in_natural_order
from sglpr_jax.data.readers.reader import Reader, ReadOptions
from sglpr_jax.data.recording import Recording

POSE_FILES = ("poses.txt", "poses.csv", "poses.tum")
"""Pose files beside the scans. 12 numbers a line are poses of the LiDAR, z up."""
TIMES_FILE = "times.txt"


def recording_names(root: Path) -> tuple[str, ...]:
    """Return the name of the folder if it contains scans, or else an empty tuple."""
    return (root.resolve().name,) if _scan_files(root) else ()


def open_recording(root: Path, name: str, options: ReadOptions) -> Recording:
    """Open the folder `root`. Warns if the format looks wrong or consecutive poses are far apart.

    Raises ValueError if two files differ only by their ending, or if the format of the .bin files cannot be detected.
    """
    paths = _scan_files(root)
    path_by_id: dict[str, Path] = {}
    for path in paths:
        first = path_by_id.setdefault(scan_id(path), path)
        if first is not path:
            raise ValueError(f"{root}: expected one file for each scan, found {first.name} and {path.name}")
    ids = tuple(path_by_id)
    positions, times, source = _read_trajectory(root, ids, options)
    records, format_description = _bin_format(paths, options.format)
    unused = describe_contents(root, without=[*paths, *(root / name for name in (*POSE_FILES, TIMES_FILE))])
    return Recording(
        name=root.resolve().name,
        ids=ids,
        paths=paths,
        read=partial(scan_of_file, format=options.format, records=records),
        positions=positions,
        times=times,
        pose_source=source,
        found=(f"format: {format_description}", *([f"left aside: {unused}"] if unused else [])),
    )


def _scan_files(root: Path) -> tuple[Path, ...]:
    """Return the scan files in a folder: .bin, .pcd and .ply or, without such files, .npy, .npz and .las."""
    return in_natural_order(root / name for name in scan_names(os.listdir(root))) if root.is_dir() else ()


def _read_trajectory(
    root: Path, ids: tuple[str, ...], options: ReadOptions
) -> tuple[Float[np.ndarray, "n 3"] | None, Float[np.ndarray, " n"] | None, str | None]:
    """Return positions (m) and times (s) of the scans and the source of the poses, each None if there is no file."""
    scans = len(ids)
    files_in_root = [root / name for name in POSE_FILES if (root / name).is_file()]
    if options.poses is None and len(files_in_root) > 1:
        raise ValueError(f"{root}: expected one pose file, found {', '.join(path.name for path in files_in_root)}")
    pose_file = options.poses or next(iter(files_in_root), None)
    times_file = options.times or (root / TIMES_FILE if (root / TIMES_FILE).is_file() else None)
    times = None if times_file is None else read_times(times_file, unit=options.time_unit)
    if times is not None and len(times) != scans:
        raise ValueError(f"{times_file}: expected {scans} rows, one per scan, found {len(times)}")
    if pose_file is None:
        return None, times, None
    twelve_numbers = "lidar" if options.poses is None else None  # the file in the folder has z up
    trajectory = read_trajectory(
        pose_file, format=options.pose_format, time_unit=options.time_unit, twelve_numbers=twelve_numbers
    )
    poses, item = trajectory.poses, f"scan of {root.resolve().name}"
    has_pose, poses, how = poses_at_scans(str(pose_file), poses, trajectory.times, times, scans=scans, item=item)
    if times is not None and not has_pose.all():
        uncovered = times[~has_pose]
        raise ValueError(
            f"{pose_file}: expected poses at the times of all {scans} scans, found none for {len(uncovered)}, the first"
            f" at {uncovered[0]:.1f} s; remove these scans, or pass the poses only to bin/evaluate, which skips them"
        )
    warn_of_jumps(poses[:, :3, 3], ids, path=pose_file)
    source = trajectory.source if options.poses is not None else pose_file.name
    scan_times = trajectory.times if times is None else times
    return poses[:, :3, 3], scan_times, f"{source}, {how}" if how else source


def _bin_format(paths: tuple[Path, ...], format: ScanFormat) -> tuple[RecordFormat, str]:
    """Return the format of .bin files whose name does not define it, and a description of the formats of all files."""
    if format != "auto":
        warn_of_doubts(paths, format)
        return "kitti", describe_format(format)  # all files have the given format, so "kitti" is not used
    unknown = [path for path in paths if format_by_name(path) is None]
    detected, how = detect_point_format(unknown) if unknown else (None, "")
    bin_format: RecordFormat = detected or "kitti"
    paths_by_format: dict[ScanFormat, list[Path]] = {}
    for path in paths:
        paths_by_format.setdefault(format_by_name(path) or bin_format, []).append(path)
    for name, of_format in paths_by_format.items():
        if named := [path for path in of_format if format_by_name(path)]:  # that of the others comes from their content
            warn_of_doubts(named, name)
    description = ", ".join(f"{len(of_format)} {describe_format(name)}" for name, of_format in paths_by_format.items())
    if len(paths_by_format) == 1:
        description = describe_format(next(iter(paths_by_format)))
    return bin_format, f"{description}, {how}" if unknown else description


READER = Reader(
    f"single scans ({', '.join(f'*{ending}' for ending in (*ENDINGS, *ARRAY_ENDINGS))})",
    recording_names,
    open_recording,
    knows_mounting=False,
    rank=9,
    takes_poses=True,
    takes_format=True,
)
