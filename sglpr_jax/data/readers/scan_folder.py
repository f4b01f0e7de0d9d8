"""Reader of a plain folder of scans, one file each. Poses and timestamps are optional.

- `my_scans/full0.bin`, `full1.bin`, ..., `full10.bin`: scans in the order of their numbers. Hidden files are ignored.
- `my_scans/poses.txt`: 12 numbers a line (LiDAR frame, z up) or 8 (TUM). `poses.tum` and `poses.csv` work, too.
- `my_scans/times.txt`: timestamps, one number a line, in seconds unless `time_unit` names another unit.
"""

from collections import Counter
from functools import partial
from pathlib import Path

import numpy as np
from jaxtyping import Float

from sglpr_jax.data.choices import RecordFormat, ScanFormat
from sglpr_jax.data.formats.bin_records import check_record, described, detect_point_format, is_record
from sglpr_jax.data.formats.pose_files import check_order, read_times, read_trajectory
from sglpr_jax.data.formats.scan_files import ARRAY_ENDINGS, ENDINGS, named_format, scan_id, scan_of_file
from sglpr_jax.data.poses import poses_at_scans, poses_of
from sglpr_jax.data.readers.listing import files_in, left_aside, scans_in
from sglpr_jax.data.readers.reader import Reader, ReadOptions
from sglpr_jax.data.recording import Recording

POSE_FILES = ("poses.txt", "poses.csv", "poses.tum")
"""Pose files beside the scans. 12 numbers a line are poses of the LiDAR, z up."""
TIMES_FILE = "times.txt"


def recording_names(root: Path) -> tuple[str, ...]:
    """Return the name of the folder if it contains scans, or else an empty tuple."""
    return (root.resolve().name,) if _scans(root) else ()


def open_recording(root: Path, name: str, options: ReadOptions) -> Recording:
    """Open the folder `root`. Warns if the format looks wrong or consecutive poses are far apart.

    Raises ValueError if two files differ only by their ending, or if the record of the .bin files cannot be detected.
    """
    paths = _scans(root) or scans_in(root, *ENDINGS, *ARRAY_ENDINGS)
    ids = _ids(root, paths)
    positions, seconds, source = _trajectory(root, len(paths), options)
    records, kinds = _formats(paths, options.format)
    aside = left_aside(root, [*paths, *(root / name for name in (*POSE_FILES, TIMES_FILE))])
    if positions is not None:
        check_order(positions, ids, path=options.poses or root / str(source))
    return Recording(
        name=root.resolve().name,
        ids=ids,
        paths=paths,
        read=partial(scan_of_file, format=options.format, records=records),
        positions=positions,
        times=seconds,
        pose_source=source,
        found=(f"format: {kinds}", *([f"left aside: {aside}"] if aside else [])),
    )


def _scans(root: Path) -> tuple[Path, ...]:
    """Scan files in a folder. Arrays count as scans if there are no other scans."""
    return files_in(root, *ENDINGS) or files_in(root, *ARRAY_ENDINGS)


def _trajectory(
    root: Path, scans: int, options: ReadOptions
) -> tuple[Float[np.ndarray, "n 3"] | None, Float[np.ndarray, " n"] | None, str | None]:
    """Positions in metres, times in seconds and the source of the poses; each may be unknown (None)."""
    beside = [root / name for name in POSE_FILES if (root / name).is_file()]
    if options.poses is None and len(beside) > 1:
        raise ValueError(f"{root}: expected one pose file, found {', '.join(path.name for path in beside)}")
    path = options.poses or next(iter(beside), None)
    clock = options.times or (root / TIMES_FILE if (root / TIMES_FILE).is_file() else None)
    seconds = None if clock is None else read_times(clock, unit=options.time_unit)
    if seconds is not None and len(seconds) != scans:
        raise ValueError(f"{clock}: expected {scans} rows, one per scan, found {len(seconds)}")
    if path is None:
        return None, seconds, None
    twelve = "lidar" if options.poses is None else None
    given = read_trajectory(path, format=options.pose_format, time_unit=options.time_unit, twelve_numbers=twelve)
    of = f"scan of {root.resolve().name}"
    found = poses_at_scans(str(path), poses_of(given.positions), given.times, seconds, scans=scans, of=of)
    if seconds is not None and not found.kept.all():
        late = seconds[~found.kept]
        raise ValueError(
            f"{path}: expected poses at the times of all {scans} scans, found none for {len(late)}, the first at "
            f"{late[0]:.1f} s; remove these scans, or pass the poses only to bin/evaluate, which skips them"
        )
    source = given.source if options.poses is not None else path.name
    said = f"{source}, {found.said}" if found.said else source
    return found.poses[:, :3, 3], given.times if seconds is None else seconds, said


def _ids(root: Path, paths: tuple[Path, ...]) -> tuple[str, ...]:
    """Names of the scans. Raises ValueError if two files have the same name."""
    first: dict[str, Path] = {}
    for path in paths:
        other = first.setdefault(scan_id(path), path)
        if other is not path:
            raise ValueError(f"{root}: expected one file for each scan, found {other.name} and {path.name}")
    return tuple(first)


def _formats(paths: tuple[Path, ...], format: ScanFormat) -> tuple[RecordFormat, str]:
    """Record of the .bin files whose name does not define it, and a description of all formats."""
    unsaid = [path for path in paths if named_format(path) is None] if format == "auto" else []
    found, how = detect_point_format(unsaid) if unsaid else (None, "")
    if is_record(format):
        check_record(paths, format)
    records: RecordFormat = found or "kitti"
    counts = Counter((named_format(path) or records) if format == "auto" else format for path in paths)
    said = {name: described(name) if is_record(name) else name for name in counts}
    kinds = ", ".join(said[name] if len(counts) == 1 else f"{count} {said[name]}" for name, count in counts.items())
    return records, f"{kinds}, {how}" if unsaid else kinds


READER = Reader(
    f"single scans ({', '.join(f'*{ending}' for ending in (*ENDINGS, *ARRAY_ENDINGS))})",
    recording_names,
    open_recording,
    knows_mounting=False,
    rank=9,
    takes_poses=True,
)
