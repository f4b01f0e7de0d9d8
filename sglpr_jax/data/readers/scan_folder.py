"""A plain folder of single scans (.bin, .pcd), with a `poses.txt` beside them or without."""

from functools import partial
from pathlib import Path

from sglpr_jax.data.formats.pose_files import read_poses
from sglpr_jax.data.formats.scan_files import ScanFormat, scan_id
from sglpr_jax.data.reader import Reader
from sglpr_jax.data.record import scan_record
from sglpr_jax.data.recording import Recording


def recording_names(root: Path) -> tuple[str, ...]:
    """Return the folder's own name if there are scans in it, else nothing."""
    return (root.resolve().name,) if _scan_paths(root) else ()


def open_recording(root: Path, *, format: ScanFormat = "auto") -> Recording:
    """Open the folder `root`; scans come in the order of their names, or of their numbers where all are numbers.

    `format`: see `read_scan`. `poses.txt` has 12 numbers a line (LiDAR frame, metres, z up), one line per scan in that
    order; without it the positions are None. Raises ValueError where it has another number of lines or is malformed.
    """
    scan_paths = _scan_paths(root)
    if not scan_paths:
        raise FileNotFoundError(f"{root}: expected scans (*.bin, *.pcd), found none")
    pose_path = root / "poses.txt"
    world_from_lidar = read_poses(pose_path) if pose_path.is_file() else None
    if world_from_lidar is not None and len(world_from_lidar) != len(scan_paths):
        raise ValueError(f"{pose_path}: expected {len(scan_paths)} rows, one per scan, found {len(world_from_lidar)}")
    return Recording(
        name=root.resolve().name,
        ids=tuple(scan_id(path) for path in scan_paths),
        positions=None if world_from_lidar is None else world_from_lidar[:, :, 3],
        times=None,
        pose_source=None if world_from_lidar is None else pose_path.name,
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
    open=lambda root, name, options: open_recording(root, format=options.format),
    rank=9,
)
