"""Maps: relocalisation of another sensor in a point cloud or a map of scans, and moving objects in a point cloud."""

from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Bool, Float, Float32, Int
from scipy.spatial.distance import cdist

import sglpr_jax
from benchmarks.drives import lidar, on_disk
from benchmarks.quality.submaps import APART_M, PASSES, RIGHT_M, rendered, scored, submaps_of_passes
from benchmarks.table import Table
from sglpr_jax.data.mounting import Mounting
from sglpr_jax.data.recording import Recording
from sglpr_jax.data.scan import Scan
from sglpr_jax.data.scan_stream import only
from sglpr_jax.loops.keyframes import Keyframe, describe_scan
from sglpr_jax.maps.config import CloudConfig
from sglpr_jax.maps.point_cloud import point_cloud
from sglpr_jax.odometry.kiss_icp import scan_odometry
from sglpr_jax.pose_graph.files import write_tum
from sglpr_jax.se3 import inverse, transformed, yaw_of
from sglpr_jax.sim.labels import MOVING
from sglpr_jax.sim.recording import SimulatedRecording, plan_sessions, simulate_recording
from sglpr_jax.sim.sensor import SENSORS

WELL_M, WELL_DEG, SURE = 0.5, 2.0, 0.99
"""Largest errors of a right pose, and the minimum probability of a sure answer."""
DAYS, ROUTES = ("2012-01-15", "2012-02-04"), ("00", "05", "08")
DRIVE_S = 60.0
"""Duration of a drive, in seconds."""
FAR_M, VOXEL_M = 60.0, 0.15
"""Maximum range of the points in the cloud, and edge of its voxels, in metres."""


def is_right(found: Float[np.ndarray, "4 4"], true: Float[np.ndarray, "4 4"]) -> bool:
    """Whether a pose is within `WELL_M` (horizontally) and `WELL_DEG` of the true one."""
    error = inverse(true) @ found
    return bool(np.hypot(*error[:2, 3]) < WELL_M and abs(np.degrees(yaw_of(error))) < WELL_DEG)


class Drive(NamedTuple):
    """Scans of one sensor in a folder, and their true poses."""

    folder: Path
    scans: Recording
    world_from_lidar: Float[np.ndarray, "n 4 4"]
    sensor: str


def _drive(root: Path, *, seed: int, sensor: str, day: int, scans: int, azimuth_steps: int) -> Drive:
    """Drive through a town on a day, with its scans in a folder below `root`, which are rendered unless they exist."""
    folder = root / f"{seed}-{sensor}-day{day}-{scans}x{azimuth_steps}"
    options = {"scans": scans, "rate_hz": scans / DRIVE_S, "seed": seed, "sensor": lidar(sensor, azimuth_steps)}
    recording = plan_sessions(DAYS, route=ROUTES[seed % len(ROUTES)], **options)[day].simulate()
    return Drive(folder, on_disk(recording, folder), recording.poses.world_from_lidar, sensor)


def cloud(
    *,
    seeds: tuple[int, ...] = (201,),
    queries: tuple[str, ...] = ("vlp16", "os1-64"),
    scans: int = 90,
    map_scans: int = 400,
    map_azimuth_steps: int = 900,
    every: int = 2,
    spacing_m: float = 4.0,
    weights: str = "sglpr",
    out: Path = Path("build/cloud_map"),
) -> None:
    """Locate scans of other sensors in a map that is a point cloud with its trajectory (extra odometry).

    hdl64e drives through a simulated town. Its scans at the poses of kiss-icp are one cloud in voxels. On another day,
    other sensors drive the same streets, partly in the opposite direction. Each of their scans within 5 m of the first
    drive is located. It is right within 0.5 m (horizontally) and 2 degrees of the true pose relative to the nearest
    pose of the first drive, so that drift of the trajectory is not counted.

    Args:
        seeds: one town for each.
        queries: sensors that are located.
        scans: scans of each drive, which takes a minute.
        map_scans: scans of the first drive.
        map_azimuth_steps: firings of the first drive's sensor per turn.
        every: every k-th scan is a query.
        spacing_m: distance between the places of the map, in metres.
        weights: the model that describes the scans.
        out: folder of the scans and clouds.
    """
    params, total = sglpr_jax.load(weights), dict[str, np.ndarray]()
    table = Table("seed", "query", "right", "of them probability >= .9", "queries")
    for seed in seeds:
        steps = {"scans": map_scans, "azimuth_steps": map_azimuth_steps}
        first = _drive(out, seed=seed, sensor="hdl64e", day=0, **steps)
        recording = _cloud_map(first)
        poses = recording.world_from_lidar
        assert poses is not None
        places = sglpr_jax.map_recording(recording, params, poses, spacing_m=spacing_m).places
        for sensor in queries:
            query = _drive(out, seed=seed, sensor=sensor, day=1, scans=scans, azimuth_steps=900)
            found = np.array(_located_in(places, params, query, first, poses, every))
            total[sensor] = total.get(sensor, 0) + found
            table.add(seed, sensor, *found)
        jax.clear_caches()
    for sensor, (right, sure, count) in total.items():
        table.add("all", sensor, f"{right / count:.3f}", f"{sure / count:.3f}", count)


def _cloud_map(drive: Drive) -> Recording:
    """Recording of a point cloud map and its trajectory by kiss-icp. Existing files of both are used again."""
    trajectory, path = (drive.folder.with_name(f"{drive.folder.name}-kiss.{suffix}") for suffix in ("tum", "pcd"))
    if not trajectory.exists():
        height_m = SENSORS[drive.sensor].height_m
        poses = scan_odometry(sglpr_jax.open_recording(drive.folder, format="kitti", sensor_height=height_m))
        write_tum(trajectory, poses, 0.5 + np.arange(len(poses)) * DRIVE_S / len(poses))
    if not path.exists():
        points = _join_scans(drive, sglpr_jax.read_odometry(trajectory, format="tum"))
        count = len(points)
        header = f"VERSION 0.7\nFIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nWIDTH {count}\nHEIGHT 1\nPOINTS {count}\n"
        path.write_bytes((header + "DATA binary\n").encode() + points.astype("<f4").tobytes())
    recording = sglpr_jax.open_recording(path, poses=trajectory)
    print("; ".join(recording.description), flush=True)
    return recording


def _join_scans(drive: Drive, poses: Float[np.ndarray, "n 4 4"]) -> Float32[np.ndarray, "m 3"]:
    """Joins all scans with `poses` to one cloud: the centroid of the points in each voxel."""
    parts = []
    for row, pose in enumerate(poses):
        points = drive.scans.points(row)
        points = points[np.linalg.norm(points, axis=1) < FAR_M]
        parts.append((points @ pose[:3, :3].T + pose[:3, 3]).astype(np.float32))
    points = np.concatenate(parts)
    voxels = np.floor(points / VOXEL_M).astype(np.int64) + (1 << 20)  # not negative
    # A voxel's number has 21 bits for each of x, y and z.
    _, voxel, counts = np.unique(voxels @ (1 << np.array([42, 21, 0])), return_inverse=True, return_counts=True)
    return np.stack([np.bincount(voxel, weights=axis) / counts for axis in points.T], axis=1).astype(np.float32)


def _located_in(
    places: sglpr_jax.PlaceMap, params: sglpr_jax.Params, query: Drive, first: Drive, poses: np.ndarray, every: int
) -> tuple[int, int, int]:
    """Relocates every `every`-th scan of `query` near the first drive in the map `places`, whose poses are `poses`.

    Returns the numbers of right answers, of right answers with a probability of at least 0.9, and of queries.
    """
    distance = cdist(query.world_from_lidar[:, :2, 3], first.world_from_lidar[:, :2, 3])
    mounting, right, sure, count = Mounting(SENSORS[query.sensor].height_m), 0, 0, 0
    for row in np.flatnonzero(distance.min(axis=1) < APART_M)[::every].tolist():
        nearest = int(distance[row].argmin())
        expected = poses[nearest] @ inverse(first.world_from_lidar[nearest]) @ query.world_from_lidar[row]
        best = places.relocate(params, Scan(points=query.scans.points(row), mounting=mounting))[0]
        is_right_pose = is_right(best.world_from_query, expected)
        right += is_right_pose
        sure += is_right_pose and best.probability >= 0.9
        count += 1
    return right, sure, count


class MappedDrive(NamedTuple):
    """A map of the first pass, and the described scans of the other passes."""

    places: sglpr_jax.PlaceMap
    keyframes: list[Keyframe]
    poses: Float[np.ndarray, "n 4 4"]
    """True pose of each query."""


def sensors(
    *,
    sensors: tuple[str, ...] = ("vlp16", "os0-32", "os1-64", "hdl64e", "mid360", "avia"),
    seeds: tuple[int, ...] = (609, 610),
    length_m: float = 0.0,
    metres: int = 110,
    spacing_m: float = 4.0,
    azimuth_steps: int = 900,
    weights: str = "sglpr",
    out: Path = Path("build/submaps"),
) -> None:
    """Locate scans of one sensor in a map of another, for all pairs.

    Each sensor drives the same street (`submaps`): once for the map, then once in the opposite and once in the same
    direction. A query within 5 m of the map is found if the nearest descriptor is within 5 m. It is relocated right
    within 0.5 m (horizontally) and 2 degrees, and wrong if its probability is at least 0.99 and its position is more
    than 5 m off.

    Args:
        sensors: names of sensors.
        seeds: one town for each.
        length_m: length of the submaps; 0 is a single scan.
        metres: length of the street.
        spacing_m: distance between two places of a map, and between two queries.
        azimuth_steps: firings of the sensor per turn, at most.
        weights: the model that describes the scans.
        out: folder of the scans.
    """
    params, passes = sglpr_jax.load(weights), dict[str, list[MappedDrive]]()
    for sensor in sensors:
        for seed in seeds:
            drive = rendered(sensor, seed, metres, azimuth_steps, out)
            recording = submaps_of_passes(drive, length_m, seed=seed)
            rows = np.array(scored(drive))
            mapped = rows[drive.passes[rows] == 0]
            first_pass = only(recording, mapped.tolist())
            places = sglpr_jax.map_recording(first_pass, params, drive.poses[mapped], spacing_m=spacing_m).places
            numbers = [list(PASSES).index(name) for name in ("opposite", "same")]
            asked = rows[np.isin(drive.passes[rows], numbers)][:: max(1, round(spacing_m))]
            keyframes = [describe_scan(params, recording.scan(row)) for row in asked.tolist()]
            passes.setdefault(sensor, []).append(MappedDrive(places, keyframes, drive.poses[asked]))
    table = Table("map", "query", "recall@1", "right", "wrong at .99", "queries")
    for mapped in sensors:
        for asked in sensors:
            results = [_locate(*towns) for towns in zip(passes[mapped], passes[asked], strict=True)]
            near, right, wrong = np.concatenate(results, axis=1)
            table.add(mapped, asked, f"{near.mean():.3f}", f"{right.mean():.3f}", wrong.sum(), len(near))


def _locate(mapped: MappedDrive, queried: MappedDrive) -> Bool[np.ndarray, "3 n"]:
    """Locates the queries of `queried` near the map of `mapped`.

    Returns for each query whether its nearest descriptor is right, its pose is right, and its pose is wrong but sure.
    """
    places = mapped.places
    distance = cdist(queried.poses[:, :2, 3], places.world_from_place[:, :2, 3])
    rows = np.flatnonzero(distance.min(axis=1) < APART_M)
    results = np.zeros((3, len(rows)), bool)
    for i, row in enumerate(rows.tolist()):
        nearest = places.index.query(queried.keyframes[row].descriptor).rows[0]
        results[0, i] = distance[row, nearest] <= RIGHT_M
        answers = places.relocate_keyframe(queried.keyframes[row], weights_hash=places.index.weights_hash)
        if answers:
            pose, true_pose = answers[0].world_from_query, queried.poses[row]
            results[1, i] = is_right(pose, true_pose)
            results[2, i] = np.hypot(*(pose - true_pose)[:2, 3]) > RIGHT_M and answers[0].probability >= SURE
    return results


def moving(
    *,
    seeds: tuple[int, ...] = (61, 62),
    sensors: tuple[str, ...] = ("hdl64e", "vlp16"),
    scans: int = 100,
    azimuth_steps: int | None = None,
) -> None:
    """Make point clouds of simulated drives with traffic, and count what is left of moving and of standing objects.

    A voxel of the cloud moves if most points in it have a label of a moving object, and stands if none has.

    Args:
        seeds: one town for each.
        sensors: names of the sensors.
        scans: scans of each drive, four a second.
        azimuth_steps: firings of a sensor per turn. None: its own number.
    """
    table = Table("sensor", "seed", "moving voxels", "removed", "standing voxels", "kept")
    for sensor in sensors:
        for seed in seeds:
            drive = simulate_recording("08", scans=scans, seed=seed, sensor=lidar(sensor, azimuth_steps))
            poses = drive.poses.world_from_lidar
            every, kept = (
                point_cloud([drive], [poses], config=CloudConfig(keep_moving=keep_moving))
                for keep_moving in (True, False)
            )
            share_of = _moving_share(drive, poses)
            before, after = share_of(every), share_of(kept)
            removed = 1 - (after > 0.5).sum() / max((before > 0.5).sum(), 1)
            table.add(
                *(sensor, seed, (before > 0.5).sum(), f"{removed:.3f}"),
                *((before == 0).sum(), f"{(after == 0).sum() / (before == 0).sum():.4f}"),
            )


def _moving_share(
    drive: SimulatedRecording, poses: Float[np.ndarray, "n 4 4"]
) -> Callable[[Float[np.ndarray, "m 3"]], Float[np.ndarray, "m"]]:
    """Function of points: the share of the drive's points in their voxels that have a label of a moving object."""

    def voxels(points: Float[np.ndarray, "m 3"]) -> Int[np.ndarray, "m"]:
        return np.floor(points / CloudConfig().voxel_m).astype(np.int64) @ [1, 1 << 20, 1 << 40]

    numbers, moves = [], []
    for row, pose in enumerate(poses):
        scan = drive.scan(row, labels=True)
        assert scan.points is not None and scan.labels is not None
        numbers.append(voxels(transformed(pose, scan.points)))
        moves.append(np.isin(scan.labels & 0xFFFF, list(MOVING.values())))
    found, rows = np.unique(np.concatenate(numbers), return_inverse=True)
    share = np.bincount(rows, weights=np.concatenate(moves)) / np.bincount(rows)
    return lambda points: share[np.searchsorted(found, voxels(points)).clip(max=len(found) - 1)]
