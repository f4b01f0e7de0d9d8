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
from sglpr_jax.data.formats.pose_files import read_poses, read_times, rows_of_frames
from sglpr_jax.data.formats.scan_files import scan_of_file
from sglpr_jax.data.mounting import MODEL_HEIGHT_M, Mounting
from sglpr_jax.data.readers.listing import files_in, names_of, scans_in
from sglpr_jax.data.readers.reader import Reader, ReadOptions
from sglpr_jax.data.recording import ReadRecord, Recording
from sglpr_jax.files import naming, read_json
from sglpr_jax.se3 import positions_from_camera

SIMULATION = "simulation.json"
"""File with the settings of a simulated dataset, written by `bin/simulate`."""


def open_recording(root: Path, name: str, options: ReadOptions) -> Recording:
    """Open `root/sequences/<name>`. Scans that do not fit KITTI's record but clearly another one are read as that one.

    Raises FileNotFoundError without scans or the named pose file, and ValueError if a scan is not named by its row.
    """
    folder = root / "sequences" / name
    paths = scans_in(folder / "velodyne", ".bin")
    ids = tuple(path.stem for path in paths)
    pose_file, times_file = _pose_file(root, name, options.pose_source), folder / "times.txt"
    positions = None
    if pose_file is not None:
        poses = read_poses(root / pose_file)
        positions = rows_of_frames(positions_from_camera(poses), ids, path=root / pose_file)
    times = read_times(times_file, unit=options.time_unit) if times_file.is_file() else None
    labels = {path.stem: path for path in files_in(folder / "labels", ".label")}
    (read, format), mounting = _format(paths, options.format), _mounting(root)
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
        found=(f"format: {format}", *([] if mounting is None else [f"sensor: {mounting}, as simulated"])),
    )


def _mounting(root: Path) -> Mounting | None:
    """Mounting in a simulated dataset, or None if the sensor is mounted as the models assume."""
    path = root / SIMULATION
    if not path.is_file():
        return None
    settings = read_json(path)
    try:
        height = float(settings["sensor"]["height_m"])
    except (TypeError, KeyError, ValueError) as error:
        expected = "the settings of a simulated dataset with sensor.height_m"
        raise ValueError(f"{path}: expected {expected}, found none") from error
    with naming(path):
        return None if height == MODEL_HEIGHT_M else Mounting(height)


def _format(paths: tuple[Path, ...], format: ScanFormat) -> tuple[ReadRecord, str]:
    """Function that reads a scan, and its format in words."""
    if format != "auto":
        return partial(scan_of_file, format=format), f"{format}, as given"
    unusual = None
    with contextlib.suppress(ValueError):  # scans that fit no format are read as KITTI's
        unusual = detect_format_unless_kitti(paths)
    if unusual is None:
        return scan_of_file, describe_format("kitti")
    return partial(scan_of_file, format=unusual), f"{describe_format(unusual)}, not KITTI's"


def _pose_file(root: Path, name: str, choice: PoseChoice) -> str | None:
    """Name of the chosen pose file. "auto" prefers SemanticKITTI's, and returns None without any file."""
    files = {"semantickitti": f"sequences/{name}/poses.txt", "kitti": f"poses/{name}.txt"}
    choices = list(files.values()) if choice == "auto" else [files[choice]]
    path = next((file for file in choices if (root / file).is_file()), None)
    if path is None and choice != "auto":
        raise FileNotFoundError(f"{root}: expected poses in {choices[0]}, found none")
    return path


READER = Reader(
    "sequences/NN/velodyne/*.bin (KITTI)", partial(names_of, pattern="sequences/*/velodyne/"), open_recording, rank=0
)
