"""Reader of nuScenes: scenes of 20 seconds, scanned by the 32-beam LiDAR on the roof. Each scene is a sequence.

- `v1.0-mini/`: `scene.json`, `sample.json`, `sample_data.json`, `ego_pose.json`, `calibrated_sensor.json`.
- `samples/LIDAR_TOP/*.pcd.bin`: key frames, two per second: float32 x, y, z, intensity, laser.
- `sweeps/LIDAR_TOP/*.pcd.bin`: the scans between the key frames (optional). Together there are twenty per second.

The tables refer to each other by tokens. Positions are those of the LiDAR in the map frame: east, north, up. The height
of the car is always 0. The points are rotated so that x points forward.
"""

import json
from collections.abc import Container, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from sglpr_jax.data.formats.bin_records import described
from sglpr_jax.data.formats.pose_files import rotations_of
from sglpr_jax.data.formats.scan_files import scan_id, scan_of_file
from sglpr_jax.data.poses import poses_of
from sglpr_jax.data.readers.reader import Reader, ReadOptions
from sglpr_jax.data.recording import Recording
from sglpr_jax.files import in_short, naming, path_inside

CHANNEL = "LIDAR_TOP"


def recording_names(root: Path) -> tuple[str, ...]:
    """Return the names of the scenes of all dataset versions in `root`, in order."""
    return tuple(sorted({name for tables in _versions(root) for name in _scenes(tables)}))


def open_recording(root: Path, name: str, options: ReadOptions) -> Recording:
    """Open a scene: its key frames and sweeps in order of time. Listed scans without a file are skipped."""
    tables = next(folder for folder in _versions(root) if name in _scenes(folder))
    scene = _scenes(tables)[name]
    samples = set(_texts(tables / "sample.json", _rows(tables / "sample.json", "scene_token", {scene}), "token"))
    table = tables / "sample_data.json"
    listed = _rows(table, "sample_token", samples)
    files = [path_inside(root, file, source=table) for file in _column(table, listed, "filename")]
    scans = [(file, row) for file, row in zip(files, listed, strict=True) if file.parent.name == CHANNEL]
    there = [(file, row) for file, row in scans if file.is_file()]
    if not there:
        raise FileNotFoundError(
            f"{root}: expected scans of {name} in samples/{CHANNEL}, found none of the {len(scans)} that {table} lists"
        )
    ticks = _numbers(table, [row for _, row in there], "timestamp", 1)[:, 0]  # microseconds
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
                f"format: {described('nuscenes')}, rotated to x forward",
                f"{keys} key frames and {len(paths) - keys} sweeps{missing}",
            ),
        )


def _versions(root: Path) -> tuple[Path, ...]:
    """Folders of tables. v1.0-mini comes first, because it is the fastest to read."""
    return tuple(sorted(path.parent for path in root.glob("v1.0-*/scene.json")))


def _scenes(tables: Path) -> dict[str, str]:
    """Token of each scene, by name. Raises ValueError if two scenes have the same name."""
    path = tables / "scene.json"
    rows = _rows(path)
    names = _texts(path, rows, "name")
    if len(set(names)) < len(names):
        twice = next(name for name in names if names.count(name) > 1)
        raise ValueError(f"{path}: expected a unique name for each scene, found {twice!r:.80} twice")
    return dict(zip(names, _texts(path, rows, "token"), strict=True))


def _positions(tables: Path, rows: Sequence[dict[str, Any]]) -> Float[np.ndarray, "n 3"]:
    """Positions of the LiDAR in the map frame, in metres."""
    world_from_car = _poses(tables / "ego_pose.json", rows, "ego_pose_token")
    car_from_lidar = _poses(tables / "calibrated_sensor.json", rows, "calibrated_sensor_token")
    return (world_from_car[:, :3, :3] @ car_from_lidar[:, :3, 3:])[:, :, 0] + world_from_car[:, :3, 3]


def _poses(path: Path, rows: Sequence[dict[str, Any]], column: str) -> Float[np.ndarray, "n 4 4"]:
    """Poses in the table rows that a column of `rows` refers to."""
    tokens = _texts(path.with_name("sample_data.json"), rows, column)
    found = {row["token"]: row for row in _rows(path, "token", set(tokens))}
    lost = [token for token in tokens if token not in found]
    if lost:
        raise ValueError(
            f"{path}: expected a row with the token {lost[0]!r}, found none ({len(lost)} broken references)"
        )
    named = [found[token] for token in tokens]
    quaternions = _numbers(path, named, "rotation", 4)[:, [1, 2, 3, 0]]  # w comes first in the file
    return poses_of(_numbers(path, named, "translation", 3), rotations_of(path, quaternions))


def _rows(path: Path, column: str = "", among: Container[Any] = ()) -> list[dict[str, Any]]:
    """Return the rows of a table, or those whose value of `column` is in `among`: some tables have millions of rows."""
    if not path.is_file():
        raise FileNotFoundError(f"{path}: expected a table, found none")

    def wanted(row: dict[str, Any]) -> dict[str, Any] | None:
        return row if not column or row.get(column) in among else None

    try:
        rows = json.loads(path.read_bytes(), object_hook=wanted)
    except (ValueError, TypeError, RecursionError) as error:
        raise ValueError(f"{path}: expected a table in JSON, found invalid JSON ({in_short(error)})") from error
    kept = [row for row in rows if row is not None] if isinstance(rows, list) else [rows]
    if not isinstance(rows, list) or not all(isinstance(row, dict) for row in kept):
        raise ValueError(f"{path}: expected a list of rows, each an object, found something else")
    return kept


def _column(path: Path, rows: Sequence[dict[str, Any]], name: str) -> list[Any]:
    lacking = next((row for row in rows if name not in row), None)
    if lacking is not None:
        raise ValueError(f"{path}: expected {name!r} in every row, found a row with {', '.join(lacking) or 'nothing'}")
    return [row[name] for row in rows]


def _texts(path: Path, rows: Sequence[dict[str, Any]], name: str) -> list[str]:
    """Return a column of names or tokens."""
    values = _column(path, rows, name)
    for value in values:
        if not isinstance(value, str) or not value:
            raise ValueError(f"{path}: expected text as {name!r} in every row, found {value!r:.80}")
    return values


def _numbers(path: Path, rows: Sequence[dict[str, Any]], name: str, size: int) -> Float[np.ndarray, "n {size}"]:
    """Return a column with `size` finite numbers in each row."""
    values = _column(path, rows, name)
    try:
        numbers = np.array(values, np.float64).reshape(len(rows), size)
    except (ValueError, TypeError, OverflowError) as error:
        raise ValueError(f"{path}: expected {size} numbers as {name!r}, found others ({in_short(error)})") from error
    if not np.isfinite(numbers).all():
        raise ValueError(f"{path}: expected finite numbers as {name!r}, found NaN or infinite ones")
    return numbers


READER = Reader(
    "v1.0-*/scene.json with samples/LIDAR_TOP/*.pcd.bin (nuScenes)",
    recording_names,
    open_recording,
    knows_mounting=False,
    rank=5,
)
