"""A plain folder of single scans, with poses and times beside them or without (`folder_poses.py`).

my_scans/full0.bin, full1.bin, ..., full10.bin   in the order of their numbers; hidden files are none
my_scans/poses.txt     12 numbers a line (LiDAR frame, z up) or 8 (TUM); or poses.tum or poses.csv
my_scans/times.txt     seconds, one number a line
"""

from collections import Counter
from functools import partial
from pathlib import Path

from sglpr_jax.data.choices import PoseFormat, RecordFormat, ScanFormat
from sglpr_jax.data.formats.bin_records import described, is_record
from sglpr_jax.data.formats.folder_poses import POSE_FILES, TIMES_FILE, folder_trajectory
from sglpr_jax.data.formats.record_size import check_record, find_record
from sglpr_jax.data.formats.scan_files import ARRAY_ENDINGS, ENDINGS, guess_format, says_its_format, scan_id
from sglpr_jax.data.formats.trajectory import check_order
from sglpr_jax.data.listing import files_in, left_aside
from sglpr_jax.data.reader import Reader
from sglpr_jax.data.record import scan_record
from sglpr_jax.data.recording import Recording


def recording_names(root: Path) -> tuple[str, ...]:
    """Return the folder's own name if there are scans in it, else nothing."""
    return (root.resolve().name,) if _scans(root) else ()


def open_recording(
    root: Path,
    *,
    format: ScanFormat = "auto",
    poses: Path | None = None,
    pose_format: PoseFormat = "auto",
    times: Path | None = None,
) -> Recording:
    """Open the folder `root`; see above for what lies in it, and `read_scan` for `format`.

    What a .bin holds is found out where neither `format` nor its name says it (`find_record`). Poses and times have
    one row for each scan; see `folder_trajectory` for the files, and for the errors. Without poses the positions are
    None. Raises ValueError where two files have the same name but for the ending. Warns where consecutive poses are
    far apart.
    """
    paths = _scans(root)
    if not paths:
        raise FileNotFoundError(f"{root}: expected scans ({_endings()}), found none")
    ids = _ids(root, paths)
    positions, seconds, source = folder_trajectory(
        root, scans=len(paths), poses=poses, pose_format=pose_format, times=times
    )
    records, kinds = _formats(paths, format)
    if positions is not None:
        check_order(positions, ids, path=poses or root / str(source))
    return Recording(
        name=root.resolve().name,
        ids=ids,
        positions=positions,
        times=seconds,
        pose_source=source,
        paths=paths,
        read=partial(scan_record, format=format, records=records),
        found=(f"format: {kinds}", *_left_aside(root, paths)),
    )


def _scans(root: Path) -> tuple[Path, ...]:
    """The scans in a folder; arrays are scans where there are no others."""
    return files_in(root, *ENDINGS) or files_in(root, *ARRAY_ENDINGS)


def _endings() -> str:
    return ", ".join(f"*{ending}" for ending in (*ENDINGS, *ARRAY_ENDINGS))


def _ids(root: Path, paths: tuple[Path, ...]) -> tuple[str, ...]:
    """The scans' names; ValueError where two files have one: which of them is the scan?"""
    first: dict[str, Path] = {}
    for path in paths:
        other = first.setdefault(scan_id(path), path)
        if other is not path:
            raise ValueError(f"{root}: expected one file for each scan, found {other.name} and {path.name}")
    return tuple(first)


def _formats(paths: tuple[Path, ...], format: ScanFormat) -> tuple[RecordFormat, str]:
    """What a .bin is whose name does not say it, and the formats of all scans in words."""
    unsaid = [path for path in paths if not says_its_format(path)] if format == "auto" else []
    found, how = find_record(unsaid) if unsaid else (None, "")
    if is_record(format):
        check_record(paths, format)
    records: RecordFormat = found or "kitti"
    counts = Counter(guess_format(path, records=records) if format == "auto" else format for path in paths)
    said = {name: described(name) if is_record(name) else name for name in counts}
    kinds = ", ".join(said[name] if len(counts) == 1 else f"{count} {said[name]}" for name, count in counts.items())
    return records, f"{kinds}, {how}" if unsaid else kinds


def _left_aside(root: Path, paths: tuple[Path, ...]) -> tuple[str, ...]:
    """What else lies in the folder."""
    aside = left_aside(root, [*paths, *(root / name for name in (*POSE_FILES, TIMES_FILE))])
    return (f"left aside: {aside}",) if aside else ()


READER = Reader(
    layout=f"single scans ({_endings()})",
    recording_names=recording_names,
    open=lambda root, name, options: open_recording(
        root, format=options.format, poses=options.poses, pose_format=options.pose_format, times=options.times
    ),
    knows_mounting=False,
    rank=9,
    takes_poses=True,
)
