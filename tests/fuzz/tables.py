"""The tables of nuScenes, which refer to each other by tokens."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from sglpr_jax.data.readers import open_recording

from .damage import BYTES, Damage
from .road import FolderRoad
from .run_files import change_value

STAMP = 1532402927647951
TURNED = [0.5**0.5, 0.0, 0.0, 0.5**0.5]
"""A quarter turn to the left: w x y z."""
SCANS = {f"samples/LIDAR_TOP/n__{STAMP + 500_000 * i}.pcd.bin": np.full((3, 5), i, "<f4").tobytes() for i in range(3)}


def tables() -> dict[str, Any]:
    """The five tables of a scene of three key frames."""
    keys = {"calibrated_sensor_token": "c", "sample_token": "s"}
    named = [
        {"token": f"d{i}", **keys, "ego_pose_token": f"e{i}", "timestamp": STAMP + 500_000 * i, "filename": file}
        for i, file in enumerate(SCANS)
    ]
    return {
        "scene": [{"token": "t", "name": "scene-0061"}],
        "sample": [{"token": "s", "scene_token": "t"}],
        "sample_data": named,
        "ego_pose": [{"token": f"e{i}", "rotation": TURNED, "translation": [9.0 * i, 2.0, 0.0]} for i in range(3)],
        "calibrated_sensor": [{"token": "c", "rotation": TURNED, "translation": [0.94, 0.0, 1.84]}],
    }


def files() -> dict[str, bytes]:
    """All files of the dataset."""
    written = {f"v1.0-mini/{name}.json": json.dumps(rows).encode() for name, rows in tables().items()}
    return {**written, **SCANS}


def damages(file: str) -> Mapping[str, Damage]:
    """Damages of a table. Scans have roads of their own, and their points are not read here."""
    return {**BYTES, "value": change_value} if file.endswith(".json") else {"flip": BYTES["flip"]}


def read_scenes(root: Path) -> Any:
    recording = open_recording(root, sensor_height=1.84)
    assert recording.positions is not None and recording.times is not None
    return [
        recording.name,
        [path.relative_to(root).as_posix() for path in recording.paths],
        np.round(recording.positions, 6).tolist(),
        recording.times.tolist(),
    ]


def said_scenes(files: Mapping[str, bytes]) -> Any:
    """The same by the textbook: the rows of each table, joined by their tokens."""
    found = {name: json.loads(files[f"v1.0-mini/{name}.json"]) for name in tables()}
    (scene,) = found["scene"]
    samples = {row["token"] for row in found["sample"] if row["scene_token"] == scene["token"]}
    rows = [row for row in found["sample_data"] if row["sample_token"] in samples and row["filename"] in files]
    rows = sorted(rows, key=lambda row: row["timestamp"])
    cars, sensors = ({row["token"]: row for row in found[name]} for name in ("ego_pose", "calibrated_sensor"))
    placed = [_placed(cars[row["ego_pose_token"]], sensors[row["calibrated_sensor_token"]]) for row in rows]
    return [scene["name"], [row["filename"] for row in rows], placed, [float(row["timestamp"]) / 1e6 for row in rows]]


def _placed(car: dict[str, Any], sensor: dict[str, Any]) -> Any:
    w, x, y, z = np.array(car["rotation"], np.float64) / np.linalg.norm(car["rotation"])
    turn = np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )
    assert abs(np.linalg.norm(sensor["rotation"]) - 1) < 0.01
    return np.round(turn @ np.array(sensor["translation"], np.float64) + car["translation"], 6).tolist()


ROADS = (
    FolderRoad(
        "nuScenes",
        "nuscenes",
        files,
        read_scenes,
        same=lambda found, content: found == said_scenes(content),
        damages=damages,
        cost=2,
    ),
)
