"""Reader of the layout of KITTI odometry and SemanticKITTI.

- `sequences/08/velodyne/000000.bin`: a scan. The file name is the number of the frame. Frames may be missing.
- `sequences/08/labels/000000.label`: SemanticKITTI's labels, optional for each frame.
- `sequences/08/times.txt`: timestamps in seconds, one line per frame (optional).
- `sequences/08/poses.txt`: SemanticKITTI's poses. Their loops are also closed in height.
- `se3/08.txt`: KITTI's ground truth. Its height drifts. The test sequences 11 to 21 have no poses.

Both pose files contain poses of the left camera. Positions are computed without `calib.txt`.
"""

from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from sglpr_jax.data.choices import PoseChoice, ScanFormat, TimeUnit
from sglpr_jax.data.formats.bin_records import described, unusual_record
from sglpr_jax.data.formats.pose_files import read_poses, read_times, rows_of
from sglpr_jax.data.listing import files_in
from sglpr_jax.data.mounting import MODEL_HEIGHT_M, Mounting
from sglpr_jax.data.reader import Reader
from sglpr_jax.data.recording import Recording, scan_record
from sglpr_jax.files import naming, read_json
from sglpr_jax.se3 import positions_from_camera

SIMULATION = "simulation.json"
"""File with the settings of a simulated dataset, written by `bin/simulate`."""


def recording_names(root: Path) -> tuple[str, ...]:
    """Return the names of the sequences in `root` that have a folder `velodyne`, in order."""
    return tuple(sorted(folder.parent.name for folder in root.glob("sequences/*/velodyne")))


def open_recording(
    root: Path,
    name: str,
    *,
    pose_source: PoseChoice = "auto",
    format: ScanFormat = "auto",
    time_unit: TimeUnit = "auto",
) -> Recording:
    """Open `root/sequences/<name>`.

    Arguments:
      root: Folder of the dataset.
      name: Name of the sequence.
      pose_source: Choice of the pose file, as in `read_trajectory`. With "auto", a sequence needs no poses. Without
        them, `positions` is `None`.
      format: Format of the scans. With "auto", scans that do not fit KITTI's record but clearly fit another record are
        read as the other one (`unusual_record`).
      time_unit: Unit of times.txt (`times_of`).

    Raises:
      FileNotFoundError: If the scans or the poses of the given `pose_source` are missing.
      ValueError: If a file is malformed, has too few rows, or a scan is not named by its row.
    """
    folder = root / "sequences" / name
    scan_paths = files_in(folder / "velodyne", ".bin")
    if not scan_paths:
        raise FileNotFoundError(f"{folder / 'velodyne'}: expected scans (*.bin), found none")
    ids = tuple(path.stem for path in scan_paths)
    if pose_source == "auto" and _pose_file(root, name, pose_source) is None:
        positions, times, pose_file = None, _times(root, name, time_unit), None
    else:
        positions, times, pose_file = read_trajectory(root, name, pose_source=pose_source, time_unit=time_unit)
    labels = {path.stem: path for path in files_in(folder / "labels", ".label")}
    reading, mounting = _read(scan_paths, format), _mounting(root)
    if mounting is not None:
        reading["found"] += (f"sensor: {mounting}, as simulated",)
    return Recording(
        name=name,
        ids=ids,
        positions=None
        if positions is None
        else positions[rows_of(ids, rows=len(positions), path=root / str(pose_file))],
        times=None if times is None else times[rows_of(ids, rows=len(times), path=folder / "times.txt")],
        pose_source=pose_file,
        paths=scan_paths,
        label_paths=tuple(labels.get(scan) for scan in ids),
        mounting=mounting,
        **reading,
    )


def _mounting(root: Path) -> Mounting | None:
    """Mounting in a simulated dataset, or None if the sensor is mounted as the models assume."""
    path = root / SIMULATION
    if not path.is_file():
        return None
    settings = read_json(path)
    sensor = settings.get("sensor") if isinstance(settings, dict) else None
    height = sensor.get("height_m") if isinstance(sensor, dict) else None
    if not isinstance(height, int | float):
        raise ValueError(f"{path}: expected the settings of a simulated dataset with sensor.height_m, found none")
    with naming(path):
        return None if height == MODEL_HEIGHT_M else Mounting(float(height))


def _read(paths: tuple[Path, ...], format: ScanFormat) -> dict[str, Any]:
    """Values for the fields `read` and `found` of the recording."""
    if format != "auto":
        return {"read": partial(scan_record, format=format), "found": (f"format: {format}, as given",)}
    unusual = unusual_record(paths)
    if unusual is None:
        return {"read": scan_record, "found": (f"format: {described('kitti')}",)}
    return {"read": partial(scan_record, format=unusual), "found": (f"format: {described(unusual)}, not KITTI's",)}


def read_trajectory(
    root: Path, name: str, *, pose_source: PoseChoice = "auto", time_unit: TimeUnit = "auto"
) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, " m"] | None, str]:
    """Read the trajectory of a sequence. The scans are not needed.

    Arguments:
      root: Folder of the dataset.
      name: Name of the sequence.
      pose_source: Choice of the pose file. "auto" prefers SemanticKITTI's.
      time_unit: Unit of times.txt (`times_of`).

    Returns:
      Positions of all frames in metres, z up; their times in seconds, or None; and the name of the pose file.

    Raises:
      FileNotFoundError: If the pose file does not exist.
      ValueError: If a file is malformed.
    """
    pose_file = _pose_file(root, name, pose_source)
    if pose_file is None:
        raise FileNotFoundError(f"{root}: expected poses in {' or '.join(_pose_files(name, pose_source))}, found none")
    return positions_from_camera(read_poses(root / pose_file)), _times(root, name, time_unit), pose_file


def _pose_files(name: str, pose_source: PoseChoice) -> list[str]:
    files = {"semantickitti": f"sequences/{name}/poses.txt", "kitti": f"poses/{name}.txt"}
    return list(files.values()) if pose_source == "auto" else [files[pose_source]]


def _pose_file(root: Path, name: str, pose_source: PoseChoice) -> str | None:
    """First existing pose file, or None."""
    return next((file for file in _pose_files(name, pose_source) if (root / file).is_file()), None)


def _times(root: Path, name: str, unit: TimeUnit) -> Float[np.ndarray, " m"] | None:
    """Times of all frames in seconds, or None if the file does not exist."""
    path = root / "sequences" / name / "times.txt"
    return read_times(path, unit=unit) if path.is_file() else None


READER = Reader(
    layout="sequences/NN/velodyne/*.bin (KITTI)",
    recording_names=recording_names,
    open=lambda root, name, options: open_recording(
        root, name, pose_source=options.pose_source, format=options.format, time_unit=options.time_unit
    ),
    rank=0,
)
