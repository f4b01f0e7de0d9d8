"""Sequences of scans in the layout of KITTI odometry and SemanticKITTI.

    sequences/08/velodyne/000000.bin   scans; the number is the frame, and frames may be left out
    sequences/08/labels/000000.label   SemanticKITTI's labels (optional, each)
    sequences/08/times.txt             seconds, one line per frame (optional)
    sequences/08/poses.txt             SemanticKITTI's poses: loops closed in height too
    poses/08.txt                       KITTI's own ground truth: its height drifts

Both pose files move the left camera, so `calib.txt` is not needed for positions.
"""

from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from sglpr_jax.data.choices import PoseChoice, ScanFormat
from sglpr_jax.data.formats.bin_records import described
from sglpr_jax.data.formats.pose_files import read_poses, read_times, rows_of
from sglpr_jax.data.formats.record_size import unusual_record
from sglpr_jax.data.listing import files_in
from sglpr_jax.data.mounting import MODEL_HEIGHT_M, Mounting
from sglpr_jax.data.reader import Reader
from sglpr_jax.data.record import scan_record
from sglpr_jax.data.recording import Recording
from sglpr_jax.files import read_json
from sglpr_jax.poses import positions_from_camera

SIMULATION = "simulation.json"
"""Beside the sequences that `bin/simulate` wrote: what they were made with."""


def recording_names(root: Path) -> tuple[str, ...]:
    """Return the names of the sequences in `root` that have a folder of scans, in order."""
    return tuple(sorted(folder.parent.name for folder in root.glob("sequences/*/velodyne")))


def open_recording(
    root: Path, name: str, *, pose_source: PoseChoice = "auto", format: ScanFormat = "auto"
) -> Recording:
    """Open `root/sequences/<name>`; see `read_trajectory` for the errors and the choice of poses.

    Scans that look like another record than KITTI's, and do not look like that, are read so (`unusual_record`).
    """
    folder = root / "sequences" / name
    scan_paths = files_in(folder / "velodyne", ".bin")
    if not scan_paths:
        raise FileNotFoundError(f"{folder / 'velodyne'}: expected scans (*.bin), found none")
    ids = tuple(path.stem for path in scan_paths)
    positions, times, pose_file = read_trajectory(root, name, pose_source=pose_source)
    labels = {path.stem: path for path in files_in(folder / "labels", ".label")}
    reading, mounting = _read(scan_paths, format), _mounting(root)
    if mounting is not None:
        reading["found"] += (f"sensor: {mounting}, as simulated",)
    return Recording(
        name=name,
        ids=ids,
        positions=positions[rows_of(ids, rows=len(positions), path=root / pose_file)],
        times=None if times is None else times[rows_of(ids, rows=len(times), path=folder / "times.txt")],
        pose_source=pose_file,
        paths=scan_paths,
        label_paths=tuple(labels.get(scan) for scan in ids),
        mounting=mounting,
        **reading,
    )


def _mounting(root: Path) -> Mounting | None:
    """Of simulated drives, whose sensor may have stood higher or lower than KITTI's; else None: as models know it."""
    path = root / SIMULATION
    if not path.is_file():
        return None
    settings = read_json(path)
    sensor = settings.get("sensor") if isinstance(settings, dict) else None
    height = sensor.get("height_m") if isinstance(sensor, dict) else None
    if not isinstance(height, int | float):
        raise ValueError(f"{path}: expected the settings of a simulated dataset with the sensor's height_m, found none")
    try:
        return None if height == MODEL_HEIGHT_M else Mounting(float(height))
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from error


def _read(paths: tuple[Path, ...], format: ScanFormat) -> dict[str, Any]:
    """How the scans are read, and what to say about it: of a recording, `read` and `found`."""
    if format != "auto":
        return {"read": partial(scan_record, format=format), "found": (f"format: {format}, as said",)}
    unusual = unusual_record(paths)
    if unusual is None:
        return {"read": scan_record, "found": (f"format: {described('kitti')}",)}
    return {"read": partial(scan_record, format=unusual), "found": (f"format: {described(unusual)}, not KITTI's",)}


def read_trajectory(
    root: Path, name: str, *, pose_source: PoseChoice = "auto"
) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, " m"] | None, str]:
    """Return the positions of all frames (metres, z up), their times or None, and the pose file's name.

    The scans themselves need not be there. `pose_source` chooses the file; "auto" takes SemanticKITTI's where it
    exists. Raises FileNotFoundError where there is no such file, ValueError where it is malformed.
    """
    pose_files = {"semantickitti": f"sequences/{name}/poses.txt", "kitti": f"poses/{name}.txt"}
    candidates = list(pose_files.values()) if pose_source == "auto" else [pose_files[pose_source]]
    pose_file = next((file for file in candidates if (root / file).is_file()), None)
    if pose_file is None:
        raise FileNotFoundError(f"{root}: expected poses in {' or '.join(candidates)}, found none")
    times_path = root / "sequences" / name / "times.txt"
    times = read_times(times_path) if times_path.is_file() else None
    return positions_from_camera(read_poses(root / pose_file)), times, pose_file


READER = Reader(
    layout="sequences/NN/velodyne/*.bin (KITTI)",
    recording_names=recording_names,
    open=lambda root, name, options: open_recording(root, name, pose_source=options.pose_source, format=options.format),
    rank=0,
)
