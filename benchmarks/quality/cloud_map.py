"""Measures relocalisation in a map that is a point cloud of another sensor, with its trajectory.

    python -m benchmarks.quality.cloud_map --seeds 201 202 --out build/cloud_map
    python -m benchmarks.quality.cloud_map --seeds 201 202 --kiss-icp --map-scans 600 --maps cloud --out build/cloud_map

A simulated town is driven by hdl64e. Its scans at noisy poses (`map_drives.noisy`) are one cloud in voxels. With
--kiss-icp, the poses are those that kiss-icp computes from the scans, of which it needs 10 a second. On another day,
other sensors drive the same streets, partly in the opposite direction. Each of their scans within 5 m of the first
drive is located by `PlaceMap.relocate`. It is right within 0.5 m (horizontally) and 2 degrees of the true pose relative
to the nearest pose of the first drive, so that drift of kiss-icp is not counted.

Maps: `cloud` (the feature), `all points` (the same without removing hidden points), `scans` (the scans of hdl64e).
"""

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import jax
import numpy as np
import tyro
from jaxtyping import Float, Float32

import sglpr_jax
from benchmarks.quality.map_drives import DRIVE_S, Drive, driven, noisy
from sglpr_jax.data.readers import cloud_map
from sglpr_jax.data.recording import Record, Recording
from sglpr_jax.odometry.kiss_icp import scan_odometry
from sglpr_jax.pose_graph.files import write_tum
from sglpr_jax.pose_graph.optimize import trajectory_error
from sglpr_jax.se3 import distances, inverse

NEAR_M, RIGHT_M, RIGHT_DEG = 5.0, 0.5, 2.0
FAR_M = 60.0
"""Maximum range of the points in the cloud, in metres."""


@dataclass(frozen=True)
class Command:
    """Which towns and sensors."""

    seeds: tuple[int, ...] = (201, 202)
    """One town for each."""
    queries: tuple[str, ...] = ("vlp16", "os1-64")
    """Sensors that are located."""
    maps: tuple[str, ...] = ("cloud", "all points", "scans")
    scans: int = 180
    """Of each drive, which takes a minute."""
    map_scans: int | None = None
    """Of the first drive, if another number."""
    map_azimuth_steps: int = 1800
    """Firings of the first drive's sensor per turn."""
    every: int = 2
    """Every k-th scan is a query."""
    spacing_m: float = 4.0
    """Distance between the places of a map, in metres."""
    voxel_m: float = 0.15
    """Edge of the voxels of the cloud, in metres."""
    kiss_icp: bool = False
    """Poses of kiss-icp instead of noisy ones (extra odometry)."""
    weights: str = "sglpr"
    out: Path = Path("build/cloud_map")


def cloud_of(drive: Drive, poses: Float[np.ndarray, "n 4 4"], voxel_m: float) -> Float32[np.ndarray, "m 3"]:
    """Centroids of the voxels of all scans, in the frame of the poses."""
    parts = []
    for row, pose in enumerate(poses):
        points = drive.points(row)
        points = points[np.linalg.norm(points, axis=1) < FAR_M]
        parts.append((points @ pose[:3, :3].T + pose[:3, 3]).astype(np.float32))
    points = np.concatenate(parts)
    voxels = np.floor(points / voxel_m).astype(np.int64) + (1 << 20)
    _, voxel, counts = np.unique(voxels @ (1 << np.array([42, 21, 0])), return_inverse=True, return_counts=True)
    return np.stack([np.bincount(voxel, weights=axis) / counts for axis in points.T], axis=1).astype(np.float32)


def write_pcd(path: Path, points: Float32[np.ndarray, "n 3"]) -> None:
    """Write a file in the Point Cloud Library's format."""
    count = len(points)
    header = f"VERSION 0.7\nFIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nWIDTH {count}\nHEIGHT 1\nPOINTS {count}\n"
    path.write_bytes((header + "DATA binary\n").encode() + points.astype("<f4").tobytes())


def unhidden(recording: Recording) -> Recording:
    """The recording of a cloud whose scans have all points around a pose."""
    options = recording.read.keywords  # type: ignore[attr-defined]

    def read(path: Path, labels: Path | None, lasers: bool) -> Record:
        points = cloud_map._points_at(options["cloud"], options["world_from_lidar"][int(path.name)])
        return Record(points=points)

    return dataclasses.replace(recording, read=read)


def opened(command: Command, seed: int) -> tuple[Drive, dict[str, Callable[[], tuple[Recording, np.ndarray]]]]:
    """First drive, and for each map a function that opens its recording and poses."""
    scans, steps = command.map_scans or command.scans, command.map_azimuth_steps
    drive = driven(command.out, seed=seed, sensor="hdl64e", day=0, scans=scans, azimuth_steps=steps)
    kind = "kiss" if command.kiss_icp else "noisy"
    trajectory = drive.folder.with_name(f"{drive.folder.name}-{kind}.tum")
    if not trajectory.exists():
        found = scan_odometry(drive.recording()) if command.kiss_icp else noisy(drive.world_from_lidar, seed=seed)
        print(f"trajectory: {trajectory_error(found, drive.world_from_lidar[:, :3, 3]):.2f} m off", flush=True)
        write_tum(trajectory, found, 0.5 + np.arange(len(found)) * DRIVE_S / scans)
    poses = sglpr_jax.read_odometry(trajectory, format="tum")
    cloud = drive.folder.with_name(f"{drive.folder.name}-{kind}-{command.voxel_m:g}.pcd")
    if not cloud.exists():
        write_pcd(cloud, cloud_of(drive, poses, command.voxel_m))

    def of_cloud() -> tuple[Recording, np.ndarray]:
        recording = sglpr_jax.open_recording(cloud, poses=trajectory)
        print("; ".join(recording.description), flush=True)
        assert recording.world_from_lidar is not None
        return recording, recording.world_from_lidar

    def of_all() -> tuple[Recording, np.ndarray]:
        recording, found = of_cloud()
        return unhidden(recording), found

    return drive, {"cloud": of_cloud, "all points": of_all, "scans": lambda: (drive.recording(), poses)}


def located(
    places: sglpr_jax.PlaceMap, params: sglpr_jax.Params, query: Drive, first: Drive, poses: np.ndarray, every: int
) -> tuple[int, int, int]:
    """Numbers of right answers, of right answers with a probability of .9 or more, and of queries."""
    apart = distances(query.world_from_lidar[:, :2, 3], first.world_from_lidar[:, :2, 3])
    right = sure = count = 0
    for row in np.flatnonzero(apart.min(axis=1) < NEAR_M)[::every].tolist():
        near = int(apart[row].argmin())
        expected = poses[near] @ inverse(first.world_from_lidar[near]) @ query.world_from_lidar[row]
        best = places.relocate(params, Record(points=query.points(row), mounting=query.mounting))[0]
        error = inverse(expected) @ best.world_from_query
        fits = np.hypot(*error[:2, 3]) < RIGHT_M and abs(np.degrees(np.arctan2(error[1, 0], error[0, 0]))) < RIGHT_DEG
        right, sure, count = right + fits, sure + (fits and best.probability >= 0.9), count + 1
    return right, sure, count


def main() -> None:
    """The entry point."""
    command = tyro.cli(Command)
    params = sglpr_jax.load(command.weights)
    total: dict[tuple[str, str], np.ndarray] = {}
    print("| seed | map | query | right | of them probability >= .9 | queries |\n|---|---|---|---|---|---|")
    for seed in command.seeds:
        first, maps = opened(command, seed)
        poses = maps["scans"]()[1]
        for name in command.maps:
            recording, map_poses = maps[name]()
            places = sglpr_jax.map_recording(recording, params, map_poses, spacing_m=command.spacing_m).places
            for sensor in command.queries:
                query = driven(command.out, seed=seed, sensor=sensor, day=1, scans=command.scans, azimuth_steps=900)
                found = np.array(located(places, params, query, first, poses, command.every))
                total[name, sensor] = total.get((name, sensor), 0) + found
                print(f"| {seed} | {name} | {sensor} | {found[0]} | {found[1]} | {found[2]} |", flush=True)
        jax.clear_caches()
    for (name, sensor), (right, sure, count) in total.items():
        print(f"| all | {name} | {sensor} | {right / count:.3f} | {sure / count:.3f} | {count} |")


if __name__ == "__main__":
    main()
