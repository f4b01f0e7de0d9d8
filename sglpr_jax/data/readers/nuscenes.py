"""Reader of nuScenes: scenes of 20 seconds, scanned by the 32-beam LiDAR on the roof. Each scene is a sequence.

- `v1.0-mini/`: `scene.json`, `sample.json`, `sample_data.json`, `ego_pose.json`, `calibrated_sensor.json`.
- `samples/LIDAR_TOP/*.pcd.bin`: key frames, two per second: float32 x, y, z, intensity, laser.
- `sweeps/LIDAR_TOP/*.pcd.bin`: the scans between the key frames (optional). Together there are twenty per second.

The tables refer to each other by tokens. Positions are those of the LiDAR in the map frame: east, north, up. The height
of the car is always 0. The points are rotated so that x points forward.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from sglpr_jax.data.formats.bin_records import describe_format
from sglpr_jax.data.formats.json_tables import column_of, poses_in_table, read_table, texts_of, vectors_of
from sglpr_jax.data.formats.scan_files import scan_id, scan_of_file
from sglpr_jax.data.readers.reader import Reader, ReadOptions
from sglpr_jax.data.recording import Recording
from sglpr_jax.data.times import time_unit_problem
from sglpr_jax.files import naming, path_inside

CHANNEL = "LIDAR_TOP"


def recording_names(root: Path) -> tuple[str, ...]:
    """Return the names of the scenes of all dataset versions in `root`, in order."""
    return tuple(sorted({name for tables in _table_folders(root) for name in _scene_tokens(tables)}))


def open_recording(root: Path, name: str, options: ReadOptions) -> Recording:
    """Open a scene: its key frames and sweeps in order of time. Scans that are listed but have no file are skipped."""
    tables = next(folder for folder in _table_folders(root) if name in _scene_tokens(folder))
    scene_token = _scene_tokens(tables)[name]
    sample_table, scan_table = tables / "sample.json", tables / "sample_data.json"
    samples = texts_of(sample_table, read_table(sample_table, "scene_token", {scene_token}), "token")
    rows_of_sensors = read_table(scan_table, "sample_token", set(samples))  # LiDAR, cameras and radars
    files = [path_inside(root, file, source=scan_table) for file in column_of(scan_table, rows_of_sensors, "filename")]
    listed = [(file, row) for file, row in zip(files, rows_of_sensors, strict=True) if file.parent.name == CHANNEL]
    existing = [(file, row) for file, row in listed if file.is_file()]
    if not existing:
        expected, found = f"scans of {name} in samples/{CHANNEL}", f"none of the {len(listed)} that {scan_table} lists"
        raise FileNotFoundError(f"{root}: expected {expected}, found {found}")
    times_us = vectors_of(scan_table, [row for _, row in existing], "timestamp", "t")[:, 0]
    order = np.argsort(times_us, kind="stable")
    first_us = times_us.min()
    if problem := f"{first_us:g}" if first_us <= 0 else time_unit_problem(times_us[order] / 1e6):
        raise ValueError(f"{scan_table}: expected timestamps in microseconds since 1970, found {problem}")
    paths, rows = zip(*(existing[i] for i in order), strict=True)
    key_frames = sum(path.parent.parent.name == "samples" for path in paths)
    missing = f", {len(listed) - len(paths)} more are listed but missing" if len(listed) > len(paths) else ""
    positions = _positions(tables, rows)
    with naming(scan_table):  # `Recording` raises ValueError if the table lists a scan twice
        return Recording(
            name=name,
            ids=tuple(map(scan_id, paths)),
            paths=paths,
            read=scan_of_file,
            positions=positions,
            times=times_us[order] / 1e6,
            pose_source=f"{tables.name}/ego_pose.json",
            found=(
                f"format: {describe_format('nuscenes')}, rotated to x forward",
                f"{key_frames} key frames and {len(paths) - key_frames} sweeps{missing}",
            ),
        )


def _table_folders(root: Path) -> tuple[Path, ...]:
    """Return the folder of tables of each dataset version. v1.0-mini comes first: it is the fastest to read."""
    return tuple(sorted(path.parent for path in root.glob("v1.0-*/scene.json")))


def _scene_tokens(tables: Path) -> dict[str, str]:
    """Return the token of each scene, by name. Raises ValueError if two scenes have the same name."""
    path = tables / "scene.json"
    rows = read_table(path)
    names = texts_of(path, rows, "name")
    if len(set(names)) < len(names):
        repeated = next(name for name in names if names.count(name) > 1)
        raise ValueError(f"{path}: expected a unique name for each scene, found {repeated!r:.80} twice")
    return dict(zip(names, texts_of(path, rows, "token"), strict=True))


def _positions(tables: Path, rows: Sequence[dict[str, Any]]) -> Float[np.ndarray, "n 3"]:
    """Return the positions of the LiDAR in the map frame, in metres, for rows of `sample_data.json`."""
    world_from_car = _referenced_poses(tables / "ego_pose.json", rows, "ego_pose_token")
    car_from_lidar = _referenced_poses(tables / "calibrated_sensor.json", rows, "calibrated_sensor_token")
    return (world_from_car[:, :3, :3] @ car_from_lidar[:, :3, 3:])[:, :, 0] + world_from_car[:, :3, 3]


def _referenced_poses(path: Path, rows: Sequence[dict[str, Any]], column: str) -> Float[np.ndarray, "n 4 4"]:
    """Return the pose in the table `path` whose token is in a column of each of `rows` of `sample_data.json`."""
    tokens = texts_of(path.with_name("sample_data.json"), rows, column)
    found_rows = read_table(path, "token", set(tokens))
    pose_rows = {row["token"]: row for row in found_rows}
    if len(pose_rows) < len(found_rows):
        raise ValueError(f"{path}: expected each token once, found {len(found_rows) - len(pose_rows)} repeated ones")
    missing = [token for token in tokens if token not in pose_rows]
    if missing:
        found = f"found none ({len(missing)} broken references)"
        raise ValueError(f"{path}: expected a row with the token {missing[0]!r}, {found}")
    return poses_in_table(path, [pose_rows[token] for token in tokens], position="translation", rotation="rotation")


READER = Reader(
    "v1.0-*/scene.json with samples/LIDAR_TOP/*.pcd.bin (nuScenes)",
    recording_names,
    open_recording,
    knows_mounting=False,
    rank=5,
)
