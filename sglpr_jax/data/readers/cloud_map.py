"""Reader of a point cloud map of another tool (.pcd, .ply, .las, .laz), with the trajectory of its LiDAR.

- `town.pcd`: points in metres.
- `trajectory.tum`: poses of the LiDAR in the frame of the points.

The recording has a scan for each pose. A scan is computed from the map on access: the points that are visible from the
pose within `REACH_M`. Poses without points around them are left out.
"""

import hashlib
from functools import partial
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float

from sglpr_jax.data.cloud_map import TiledCloud, remove_hidden_points, tiled_cloud
from sglpr_jax.data.formats.pose_files import read_trajectory
from sglpr_jax.data.formats.scan_files import cloud_blocks, is_cloud_file
from sglpr_jax.data.mounting import MODEL_HEIGHT_M, common_mounting, estimate_mounting
from sglpr_jax.data.readers.reader import Reader, ReadOptions
from sglpr_jax.data.recording import Recording
from sglpr_jax.data.scan import Scan
from sglpr_jax.data.scan_stream import only
from sglpr_jax.files import warn

REACH_M = 36.0
"""Maximum distance of a point from the sensor, in metres: the corner of an image of 50 m."""
AROUND_M = 20.0
"""Maximum distance in x, y and z from a pose to the nearest points of the map, in metres. Other poses are left out."""
POSES_CHECKED = 11
"""Number of poses whose height above the ground is measured, spread over the trajectory."""
LOWEST_M = 0.25
"""Minimum height of a LiDAR above the ground, in metres. Lower poses are those of the robot's base."""


def recording_names(root: Path) -> tuple[str, ...]:
    """Return the name of the map without its ending, or an empty tuple if `root` is no map."""
    return (root.stem,) if is_cloud_file(root) else ()


def open_recording(root: Path, name: str, options: ReadOptions) -> Recording:
    """Read a map, and open the scans that its LiDAR would measure at each pose.

    Raises ValueError without `options.poses`, if no pose has points around it, or if the map is too large.
    """
    poses = options.poses
    if poses is None:
        raise ValueError(
            f"{root}: expected a point cloud map with the poses of its LiDAR (--poses trajectory.tum), found no poses;"
            " put single scans into a folder, or read them with read_scan"
        )
    trajectory = read_trajectory(poses, format=options.pose_format, times=options.times, time_unit=options.time_unit)
    cloud = tiled_cloud(cloud_blocks(root), positions=trajectory.positions, reach_m=REACH_M, source=root)
    has_points = _have_points(cloud, trajectory.positions, root, poses)
    world_from_lidar = _raise_poses_on_ground(cloud, trajectory.poses, np.flatnonzero(has_points), poses)
    ids = tuple(f"{row:06d}" for row in range(len(has_points)))
    used = f"{cloud.total} points, {len(cloud.points)} of them used (near the trajectory, one per voxel, not moving)"
    poses_hash = hashlib.sha256(world_from_lidar.tobytes()).hexdigest()
    recording = Recording(
        name=root.stem,
        ids=ids,
        positions=world_from_lidar[:, :3, 3],
        times=trajectory.times,
        pose_source=trajectory.source,
        paths=tuple(map(Path, ids)),
        read=partial(_read, cloud=cloud, world_from_lidar=world_from_lidar, poses_hash=poses_hash),
        on_disk=False,
        world_from_lidar=world_from_lidar,
        containers=(root,),
        found=(f"format: point cloud map {root.name}, {used}, {cloud.spacing_m:.2f} m apart; scans computed from it",),
    )
    return recording if has_points.all() else only(recording, np.flatnonzero(has_points).tolist())


def _read(
    path: Path, labels: Path | None, *, cloud: TiledCloud, world_from_lidar: Float[np.ndarray, "n 4 4"], poses_hash: str
) -> Scan:
    """Compute the scan of a pose for a `Recording`. `path` is its id, which is the row of the pose. `poses_hash` is
    for caches only, which compare the arguments of this function."""
    points = _points_at(cloud, world_from_lidar[int(path.name)])
    return Scan(points=remove_hidden_points(points, spacing_m=cloud.spacing_m, reach_m=REACH_M))


def _points_at(cloud: TiledCloud, world_from_lidar: Float[np.ndarray, "4 4"]) -> np.ndarray:
    """Return all points of the map within `REACH_M` of a pose, in the LiDAR frame."""
    return cloud.near(world_from_lidar[:3, 3], REACH_M) @ world_from_lidar[:3, :3].astype(np.float32)


def _have_points(
    cloud: TiledCloud, positions: Float[np.ndarray, "n 3"], root: Path, poses: Path
) -> Bool[np.ndarray, " n"]:
    """Whether the map has points around each position. Warns if some have none, raises ValueError if all have none."""
    from scipy.spatial import KDTree  # imported here because the import is slow

    occupied_cells = np.unique(np.round(cloud.points / AROUND_M).astype(np.int32), axis=0)
    has_points = np.zeros(len(positions), bool)
    if len(occupied_cells):
        has_points = KDTree(occupied_cells * AROUND_M).query(positions - cloud.origin, p=np.inf)[0] < AROUND_M
    map_extent = _describe_extent(cloud.lowest, cloud.highest)
    if not has_points.any():
        pose_extent = _describe_extent(positions.min(axis=0), positions.max(axis=0))
        expected = f"poses in the frame of {root.name}, which covers {map_extent}"
        raise ValueError(f"{poses}: expected {expected}, found poses at {pose_extent}")
    empty_rows = np.flatnonzero(~has_points)
    if len(empty_rows):
        first = ", ".join(f"{value:.1f}" for value in positions[empty_rows[0]])
        warn(
            f"{poses}: expected points of {root.name} within {AROUND_M:g} m of each pose, found none at"
            f" {len(empty_rows)} of {len(positions)} poses, which are left out, the first in row {empty_rows[0] + 1} at"
            f" ({first}); the map covers {map_extent}"
        )
    return has_points


def _describe_extent(lowest: Float[np.ndarray, "3"], highest: Float[np.ndarray, "3"]) -> str:
    ranges = zip("xyz", lowest, highest, strict=True)
    return ", ".join(f"{axis} {low:.0f} to {high:.0f} m" for axis, low, high in ranges)


def _raise_poses_on_ground(
    cloud: TiledCloud, world_from_lidar: Float[np.ndarray, "n 4 4"], rows: np.ndarray, poses: Path
) -> Float[np.ndarray, "n 4 4"]:
    """If the poses (by those in some `rows`) are on the ground, warn and raise them to the height of a LiDAR."""
    sample = rows[np.unique(np.linspace(0, len(rows) - 1, POSES_CHECKED).astype(int))]
    mounting = common_mounting(estimate_mounting(_points_at(cloud, world_from_lidar[row])) for row in sample)
    if mounting is None or abs(mounting.height_m) > LOWEST_M:
        return world_from_lidar
    raised_m = MODEL_HEIGHT_M - mounting.height_m
    warn(
        f"{poses}: expected poses of the LiDAR, found poses {mounting.height_m:.2f} m above the ground, as of the"
        f" robot's base; the scans are computed {raised_m:.2f} m above them"
    )
    base_from_lidar = np.eye(4)
    base_from_lidar[:3, 3] = raised_m * np.array(mounting.up)
    return world_from_lidar @ base_from_lidar


READER = Reader(
    "*.pcd, *.ply, *.las or *.laz (point cloud map, with poses)",
    recording_names,
    open_recording,
    knows_mounting=False,
    takes_poses=True,
)
