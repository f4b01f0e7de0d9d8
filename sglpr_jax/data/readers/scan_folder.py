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
from sglpr_jax.data.formats.bin_records import check_record, describe_format, detect_point_format, is_record
from sglpr_jax.data.formats.pose_files import check_order, read_times, read_trajectory
from sglpr_jax.data.formats.scan_files import ARRAY_ENDINGS, ENDINGS, named_format, scan_id, scan_of_file
from sglpr_jax.data.poses import poses_at_scans, poses_of
from sglpr_jax.data.readers.listing import files_in, other_contents, scans_in
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
    files = {scan_id(path): path for path in reversed(paths)}
    twice = next((path for path in paths if files[scan_id(path)] is not path), None)
    if twice is not None:
        first = files[scan_id(twice)]
        raise ValueError(f"{root}: expected one file for each scan, found {first.name} and {twice.name}")
    ids = tuple(map(scan_id, paths))
    positions, times, source = _trajectory(root, len(paths), options)
    records, format = _formats(paths, options.format)
    aside = other_contents(root, [*paths, *(root / name for name in (*POSE_FILES, TIMES_FILE))])
    if positions is not None:
        check_order(positions, ids, path=options.poses or root / str(source))
    return Recording(
        name=root.resolve().name,
        ids=ids,
        paths=paths,
        read=partial(scan_of_file, format=options.format, records=records),
        positions=positions,
        times=times,
        pose_source=source,
        found=(f"format: {format}", *([f"left aside: {aside}"] if aside else [])),
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
    times_file = options.times or (root / TIMES_FILE if (root / TIMES_FILE).is_file() else None)
    times = None if times_file is None else read_times(times_file, unit=options.time_unit)
    if times is not None and len(times) != scans:
        raise ValueError(f"{times_file}: expected {scans} rows, one per scan, found {len(times)}")
    if path is None:
        return None, times, None
    twelve = "lidar" if options.poses is None else None
    track = read_trajectory(path, format=options.pose_format, time_unit=options.time_unit, twelve_numbers=twelve)
    item = f"scan of {root.resolve().name}"
    kept, poses, how = poses_at_scans(str(path), poses_of(track.positions), track.times, times, scans=scans, item=item)
    if times is not None and not kept.all():
        late = times[~kept]
        raise ValueError(
            f"{path}: expected poses at the times of all {scans} scans, found none for {len(late)}, the first at "
            f"{late[0]:.1f} s; remove these scans, or pass the poses only to bin/evaluate, which skips them"
        )
    source = track.source if options.poses is not None else path.name
    return poses[:, :3, 3], track.times if times is None else times, f"{source}, {how}" if how else source


def _formats(paths: tuple[Path, ...], format: ScanFormat) -> tuple[RecordFormat, str]:
    """Record of the .bin files whose name does not define it, and a description of all formats."""
    if format != "auto":
        if is_record(format):
            check_record(paths, format)
        return "kitti", describe_format(format)
    names = [named_format(path) for path in paths]
    unnamed = [path for path, name in zip(paths, names, strict=True) if name is None]
    detected, how = detect_point_format(unnamed) if unnamed else (None, "")
    records: RecordFormat = detected or "kitti"
    counts = Counter(name or records for name in names)
    texts = {name: describe_format(name) for name in counts}
    kinds = ", ".join(texts[name] if len(counts) == 1 else f"{count} {texts[name]}" for name, count in counts.items())
    return records, f"{kinds}, {how}" if unnamed else kinds


READER = Reader(
    f"single scans ({', '.join(f'*{ending}' for ending in (*ENDINGS, *ARRAY_ENDINGS))})",
    recording_names,
    open_recording,
    knows_mounting=False,
    rank=9,
    takes_poses=True,
)
