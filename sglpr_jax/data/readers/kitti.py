"""Reader of the layout of KITTI odometry and SemanticKITTI.

- `sequences/08/velodyne/000000.bin`: a scan. The file name is the number of the frame. Frames may be missing.
- `sequences/08/labels/000000.label`: SemanticKITTI's labels, optional for each frame.
- `sequences/08/times.txt`: timestamps in seconds, one line per frame (optional).
- `sequences/08/poses.txt`: SemanticKITTI's poses. Their loops are also closed in height.
- `poses/08.txt`: KITTI's ground truth. Its height drifts. The test sequences 11 to 21 have no poses.

Both pose files contain poses of the left camera. Positions are computed without `calib.txt`.
"""

import contextlib
from functools import partial
from pathlib import Path

from sglpr_jax.data.choices import PoseChoice, ScanFormat
from sglpr_jax.data.formats.bin_records import describe_format, detect_format_unless_kitti
from sglpr_jax.data.formats.pose_files import read_kitti, read_times, rows_of_frames
from sglpr_jax.data.formats.scan_files import scan_of_file
from sglpr_jax.data.readers.listing import files_in, names_of, scans_in
from sglpr_jax.data.readers.reader import Reader, ReadOptions
from sglpr_jax.data.readers.simulation import simulated_mounting
from sglpr_jax.data.recording import ReadScan, Recording


def open_recording(root: Path, name: str, options: ReadOptions) -> Recording:
    """Open the sequence `root/sequences/<name>`. If its scans do not fit KITTI's format, the format is detected."""
    folder = root / "sequences" / name
    paths = scans_in(folder / "velodyne", ".bin")
    ids = tuple(path.stem for path in paths)
    pose_file = _choose_pose_file(root, name, options.pose_source)
    positions = None
    if pose_file is not None:
        positions = rows_of_frames(read_kitti(root / pose_file), ids, path=root / pose_file)[:, :3, 3]
    times_file = folder / "times.txt"
    times = read_times(times_file, unit=options.time_unit) if times_file.is_file() else None
    labels = {path.stem: path for path in files_in(folder / "labels", ".label")}
    read, format_description = _scan_reader(paths, options.format)
    mounting = simulated_mounting(root)
    return Recording(
        name=name,
        ids=ids,
        paths=paths,
        read=read,
        positions=positions,
        times=None if times is None else rows_of_frames(times, ids, path=times_file),
        pose_source=pose_file,
        label_paths=tuple(labels.get(scan) for scan in ids),
        mounting=mounting,
        found=(f"format: {format_description}", *([] if mounting is None else [f"sensor: {mounting}, as simulated"])),
    )


def _scan_reader(paths: tuple[Path, ...], format: ScanFormat) -> tuple[ReadScan, str]:
    """Return a function that reads a scan of the sequence, and a description of the format."""
    if format != "auto":
        return partial(scan_of_file, format=format), f"{format}, as given"
    other_format = None
    with contextlib.suppress(ValueError):  # scans that fit no format are read as KITTI's
        other_format = detect_format_unless_kitti(paths)
    if other_format is None:
        return scan_of_file, describe_format("kitti")
    return partial(scan_of_file, format=other_format), f"{describe_format(other_format)}, not KITTI's"


def _choose_pose_file(root: Path, name: str, choice: PoseChoice) -> str | None:
    """Return the path of the chosen pose file in `root`. "auto" prefers SemanticKITTI's; without any, returns None."""
    files = {"semantickitti": f"sequences/{name}/poses.txt", "kitti": f"poses/{name}.txt"}
    candidates = list(files.values()) if choice == "auto" else [files[choice]]
    pose_file = next((file for file in candidates if (root / file).is_file()), None)
    if pose_file is None and choice != "auto":
        raise FileNotFoundError(f"{root}: expected poses in {candidates[0]}, found none")
    return pose_file


READER = Reader(
    "sequences/NN/velodyne/*.bin (KITTI)",
    partial(names_of, pattern="sequences/*/velodyne/"),
    open_recording,
    rank=0,
    takes_format=True,
)
