"""Simulated drives on disk, in the layout of KITTI odometry and SemanticKITTI."""

import dataclasses
import json
import os
from collections.abc import Callable, Sequence
from pathlib import Path

import jax
import numpy as np
from jaxtyping import Float

from sglpr_jax.sim.drive import ROUTES, plan_drive, streets_needed
from sglpr_jax.sim.sensor import HDL64E, Sensor, scan
from sglpr_jax.sim.world import build_world

SETTINGS_FILE = "simulation.json"
VERSION = 1
"""Of what the simulator makes of a seed; a change in its scans needs a new one."""
CAMERA_FROM_LIDAR = np.array([[0.0, -1, 0, 0], [0, 0, -1, 0], [1, 0, 0, 0], [0, 0, 0, 1]])
"""Camera x right, y down, z forward from LiDAR x forward, y left, z up; both at one place."""

Progress = Callable[[str, int, int], None]


def write_dataset(
    root: Path,
    *,
    names: Sequence[str] = ("00", "05", "08"),
    scans: int = 300,
    sensor: Sensor = HDL64E,
    seed: int = 0,
    progress: Progress | None = None,
) -> Path:
    """Write the drives `names` of `scans` scans each under `root`/sequences and return `root`.

    Every drive has a town of its own, drawn from `seed` and its name. Scans that are there already are kept, so a run
    that was cut off goes on where it stopped, to the same bytes; a sequence without `poses.txt` is unfinished.
    `progress(name, done, scans)` is called after every scan.

    Raises ValueError for an unknown name and where `root` holds another dataset or one of other settings.
    """
    unknown = [name for name in names if name not in ROUTES]
    if unknown or scans < 2:
        raise ValueError(f"expected drives among {', '.join(ROUTES)} with 2 scans or more, found {unknown}, {scans}")
    _claim(root, {"version": VERSION, "seed": seed, "scans": scans, "sensor": dataclasses.asdict(sensor)})
    for name in names:
        _write_sequence(root / "sequences" / name, name, scans=scans, sensor=sensor, seed=seed, progress=progress)
    return root


def _claim(root: Path, settings: dict) -> None:
    """Note the settings in `root`, or make sure that they are those already there."""
    path = root / SETTINGS_FILE
    settings = json.loads(json.dumps(settings))  # as JSON gives them back: tuples are lists
    if not path.exists():
        if (root / "sequences").exists():
            raise ValueError(
                f"{root} holds sequences that were not simulated (no {SETTINGS_FILE}); choose another folder"
            )
        root.mkdir(parents=True, exist_ok=True)
        _write(path, json.dumps(settings, indent=1).encode())
        return
    found = json.loads(path.read_text())
    different = [key for key in settings if found.get(key) != settings[key]]
    if different:
        described = ", ".join(f"{key} {settings[key]} (found {found.get(key)})" for key in different)
        raise ValueError(f"{path} belongs to another simulated dataset; expected {described}; choose another folder")


def _write_sequence(
    folder: Path, name: str, *, scans: int, sensor: Sensor, seed: int, progress: Progress | None
) -> None:
    world = build_world((seed, int(name)), streets=streets_needed(name, scans))
    rng = np.random.default_rng((seed, int(name), 1))
    drive = plan_drive(rng, name, world, scans=scans, height_m=sensor.height_m)
    key = jax.random.fold_in(jax.random.key(seed), int(name))
    (folder / "velodyne").mkdir(parents=True, exist_ok=True)
    (folder / "labels").mkdir(exist_ok=True)
    for i, world_from_lidar in enumerate(drive.world_from_lidar):
        points_file, label_file = folder / "velodyne" / f"{i:06d}.bin", folder / "labels" / f"{i:06d}.label"
        if not (points_file.exists() and label_file.exists()):
            points, labels = scan(jax.random.fold_in(key, i), world, world_from_lidar, sensor=sensor)
            _write(label_file, labels.astype("<u4").tobytes())
            _write(points_file, points.astype("<f4").tobytes())
        if progress is not None:
            progress(name, i + 1, scans)
    _write(folder / "calib.txt", _calibration().encode())
    _write(folder / "times.txt", "".join(f"{time:.6e}\n" for time in drive.times).encode())
    _write(folder / "poses.txt", _camera_poses(drive.world_from_lidar).encode())


def _row(matrix: Float[np.ndarray, "r 4"]) -> str:
    return " ".join(f"{value:.9g}" for value in matrix[:3].ravel())


def _calibration() -> str:
    """KITTI's calib.txt; nothing here has a camera, so its projections are identities."""
    projections = "".join(f"P{i}: {_row(np.eye(4))}\n" for i in range(4))
    return f"{projections}Tr: {_row(CAMERA_FROM_LIDAR)}\n"


def _camera_poses(world_from_lidar: Float[np.ndarray, "n 4 4"]) -> str:
    """Lines of poses.txt: world_from_camera, in a world whose axes are a camera's as well."""
    poses = CAMERA_FROM_LIDAR @ world_from_lidar @ CAMERA_FROM_LIDAR.T
    return "".join(_row(pose) + "\n" for pose in poses)


def _write(path: Path, content: bytes) -> None:
    """Write a file whole or not at all."""
    temporary = path.with_name(f".{path.name}.{os.getpid()}")
    temporary.write_bytes(content)
    os.replace(temporary, path)
