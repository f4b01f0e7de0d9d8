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
from sglpr_jax.files import naming, path_inside

CHANNEL = "LIDAR_TOP"


def recording_names(root: Path) -> tuple[str, ...]:
    """Return the names of the scenes of all dataset versions in `root`, in order."""
    return tuple(sorted({name for tables in _versions(root) for name in _scenes(tables)}))


def open_recording(root: Path, name: str, options: ReadOptions) -> Recording:
    """Open a scene: its key frames and sweeps in order of time. Listed scans without a file are skipped."""
    tables = next(folder for folder in _versions(root) if name in _scenes(folder))
    scene = _scenes(tables)[name]
    samples = set(texts_of(tables / "sample.json", read_table(tables / "sample.json", "scene_token", {scene}), "token"))
    table = tables / "sample_data.json"
    listed = read_table(table, "sample_token", samples)
    files = [path_inside(root, file, source=table) for file in column_of(table, listed, "filename")]
    scans = [(file, row) for file, row in zip(files, listed, strict=True) if file.parent.name == CHANNEL]
    there = [(file, row) for file, row in scans if file.is_file()]
    if not there:
        raise FileNotFoundError(
            f"{root}: expected scans of {name} in samples/{CHANNEL}, found none of the {len(scans)} that {table} lists"
        )
    ticks = vectors_of(table, [row for _, row in there], "timestamp", "t")[:, 0]  # microseconds
    order = np.argsort(ticks, kind="stable")
    paths, rows = zip(*(there[i] for i in order), strict=True)
    keys = sum(path.parent.parent.name == "samples" for path in paths)
    missing = f", {len(scans) - len(paths)} more are listed but missing" if len(scans) > len(paths) else ""
    positions = _positions(tables, rows)
    with naming(table):  # a scan may be listed twice
        return Recording(
            name=name,
            ids=tuple(map(scan_id, paths)),
            paths=paths,
            read=scan_of_file,
            positions=positions,
            times=ticks[order] / 1e6,
            pose_source=f"{tables.name}/ego_pose.json",
            found=(
                f"format: {describe_format('nuscenes')}, rotated to x forward",
                f"{keys} key frames and {len(paths) - keys} sweeps{missing}",
            ),
        )


def _versions(root: Path) -> tuple[Path, ...]:
    """Folders of tables. v1.0-mini comes first, because it is the fastest to read."""
    return tuple(sorted(path.parent for path in root.glob("v1.0-*/scene.json")))


def _scenes(tables: Path) -> dict[str, str]:
    """Token of each scene, by name. Raises ValueError if two scenes have the same name."""
    path = tables / "scene.json"
    rows = read_table(path)
    names = texts_of(path, rows, "name")
    if len(set(names)) < len(names):
        twice = next(name for name in names if names.count(name) > 1)
        raise ValueError(f"{path}: expected a unique name for each scene, found {twice!r:.80} twice")
    return dict(zip(names, texts_of(path, rows, "token"), strict=True))


def _positions(tables: Path, rows: Sequence[dict[str, Any]]) -> Float[np.ndarray, "n 3"]:
    """Positions of the LiDAR in the map frame, in metres."""
    world_from_car = _poses(tables / "ego_pose.json", rows, "ego_pose_token")
    car_from_lidar = _poses(tables / "calibrated_sensor.json", rows, "calibrated_sensor_token")
    return (world_from_car[:, :3, :3] @ car_from_lidar[:, :3, 3:])[:, :, 0] + world_from_car[:, :3, 3]


def _poses(path: Path, rows: Sequence[dict[str, Any]], column: str) -> Float[np.ndarray, "n 4 4"]:
    """Poses in the table rows that a column of `rows` refers to."""
    tokens = texts_of(path.with_name("sample_data.json"), rows, column)
    poses = {row["token"]: row for row in read_table(path, "token", set(tokens))}
    lost = [token for token in tokens if token not in poses]
    if lost:
        raise ValueError(
            f"{path}: expected a row with the token {lost[0]!r}, found none ({len(lost)} broken references)"
        )
    return poses_in_table(path, [poses[token] for token in tokens], position="translation", rotation="rotation")


READER = Reader(
    "v1.0-*/scene.json with samples/LIDAR_TOP/*.pcd.bin (nuScenes)",
    recording_names,
    open_recording,
    knows_mounting=False,
    rank=5,
)
