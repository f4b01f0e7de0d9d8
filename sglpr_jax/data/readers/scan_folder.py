"""Reader of a plain folder of scans, one file each. Poses and timestamps are optional (`folder_trajectory`).

- `my_scans/full0.bin`, `full1.bin`, ..., `full10.bin`: scans in the order of their numbers. Hidden files are ignored.
- `my_scans/poses.txt`: 12 numbers a line (LiDAR frame, z up) or 8 (TUM). `poses.tum` and `poses.csv` work, too.
- `my_scans/times.txt`: timestamps, one number a line, in seconds unless `time_unit` names another unit.
"""

from collections import Counter
from functools import partial
from pathlib import Path

from sglpr_jax.data.choices import RecordFormat, ScanFormat
from sglpr_jax.data.formats.bin_records import check_record, described, find_record, is_record
from sglpr_jax.data.formats.pose_files import POSE_FILES, TIMES_FILE, check_order, folder_trajectory
from sglpr_jax.data.formats.scan_files import ARRAY_ENDINGS, ENDINGS, named_format, scan_id
from sglpr_jax.data.readers.listing import files_in, left_aside, scans_in
from sglpr_jax.data.readers.reader import Reader, ReadOptions
from sglpr_jax.data.recording import Recording, scan_record


def recording_names(root: Path) -> tuple[str, ...]:
    """Return the name of the folder if it contains scans, or else an empty tuple."""
    return (root.resolve().name,) if _scans(root) else ()


def open_recording(root: Path, name: str, options: ReadOptions) -> Recording:
    """Open the folder `root`. Warns if the format looks wrong or consecutive poses are far apart.

    If neither `options.format` nor the name defines the record of a .bin file, it is detected (`find_record`).

    Raises FileNotFoundError without scans, poses or times (`folder_trajectory`), and ValueError if two files differ
    only by their ending, the record cannot be detected, or the poses or timestamps are malformed.
    """
    paths = _scans(root) or scans_in(root, *ENDINGS, *ARRAY_ENDINGS)
    ids = _ids(root, paths)
    positions, seconds, source = folder_trajectory(
        root,
        scans=len(paths),
        poses=options.poses,
        pose_format=options.pose_format,
        times=options.times,
        time_unit=options.time_unit,
    )
    records, kinds = _formats(paths, options.format)
    aside = left_aside(root, [*paths, *(root / name for name in (*POSE_FILES, TIMES_FILE))])
    if positions is not None:
        check_order(positions, ids, path=options.poses or root / str(source))
    return Recording(
        name=root.resolve().name,
        ids=ids,
        paths=paths,
        read=partial(scan_record, format=options.format, records=records),
        positions=positions,
        times=seconds,
        pose_source=source,
        found=(f"format: {kinds}", *([f"left aside: {aside}"] if aside else [])),
    )


def _scans(root: Path) -> tuple[Path, ...]:
    """Scan files in a folder. Arrays count as scans if there are no other scans."""
    return files_in(root, *ENDINGS) or files_in(root, *ARRAY_ENDINGS)


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
    found, how = find_record(unsaid) if unsaid else (None, "")
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
