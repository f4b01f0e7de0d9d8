"""A plain folder of single scans (.bin, .pcd), with poses and times beside them or without (`folder_poses.py`)."""

from functools import partial
from pathlib import Path

from sglpr_jax.data.formats.folder_poses import folder_trajectory
from sglpr_jax.data.formats.scan_files import ScanFormat, scan_id
from sglpr_jax.data.formats.trajectory import PoseFormat
from sglpr_jax.data.reader import Reader
from sglpr_jax.data.record import scan_record
from sglpr_jax.data.recording import Recording


def recording_names(root: Path) -> tuple[str, ...]:
    """Return the folder's own name if there are scans in it, else nothing."""
    return (root.resolve().name,) if _scan_paths(root) else ()


def open_recording(
    root: Path,
    *,
    format: ScanFormat = "auto",
    poses: Path | None = None,
    pose_format: PoseFormat = "auto",
    times: Path | None = None,
) -> Recording:
    """Open the folder `root`; scans come in the order of their names, or of their numbers where all are numbers.

    `format`: see `read_scan`. Poses and times have one row per scan in that order; see `folder_trajectory` for the
    files, and for the errors. Without poses the positions are None.
    """
    scan_paths = _scan_paths(root)
    if not scan_paths:
        raise FileNotFoundError(f"{root}: expected scans (*.bin, *.pcd), found none")
    positions, seconds, source = folder_trajectory(
        root, scans=len(scan_paths), poses=poses, pose_format=pose_format, times=times
    )
    return Recording(
        name=root.resolve().name,
        ids=tuple(scan_id(path) for path in scan_paths),
        positions=positions,
        times=seconds,
        pose_source=source,
        paths=scan_paths,
        read=partial(scan_record, format=format),
    )


def _scan_paths(root: Path) -> tuple[Path, ...]:
    paths = sorted(path for path in root.iterdir() if path.suffix in (".bin", ".pcd")) if root.is_dir() else []
    if all(scan_id(path).isdecimal() for path in paths):
        paths.sort(key=lambda path: int(scan_id(path)))
    return tuple(paths)


READER = Reader(
    layout="single scans (*.bin, *.pcd)",
    recording_names=recording_names,
    open=lambda root, name, options: open_recording(
        root, format=options.format, poses=options.poses, pose_format=options.pose_format, times=options.times
    ),
    rank=9,
    takes_poses=True,
)
