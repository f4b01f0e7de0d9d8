"""Point cloud of recordings with corrected poses, without moving objects.

A moving object leaves a trail in the cloud. Other scans see through the trail: they have points behind it.
"""

from collections.abc import Callable, Iterable, Iterator, Sequence

import numpy as np
from jaxtyping import Bool, Float, Int64
from numpy.typing import ArrayLike
from scipy.ndimage import minimum_filter1d

from sglpr_jax.data.cloud_map import height_above_ground
from sglpr_jax.data.poses import as_scan_poses
from sglpr_jax.data.recording import Recording
from sglpr_jax.data.scan import Scan
from sglpr_jax.data.scan_stream import OnBadScan, scan_stream
from sglpr_jax.fields import check_is
from sglpr_jax.files import warn
from sglpr_jax.maps.config import CloudConfig
from sglpr_jax.se3 import transformed
from sglpr_jax.voxels import ABOVE, VoxelCloud, voxel_numbers

BLOCK_M = 0.3
"""Edge of the blocks of space that are seen through or not, in metres."""
SEEN_REACH_M = 25.0
"""Maximum distance at which a scan sees through a block, in metres. Beyond it, the rays are too far apart."""
PIXEL_DEG = 0.5
"""Edge of a pixel of the range image, in degrees."""
BEHIND_M = 0.5
"""Minimum distance of the points behind a block that is seen through, in metres."""
GROUND_M = 0.3
"""Maximum height of the ground, in metres. Rays that pass it at a small angle do not see through it."""
LEAST_SEEN = 2
"""Minimum number of scans that see through a block of a moving object."""
LAYERS = 5
"""Number of blocks above a moving one that belong to it if no more scans have a point in them."""
STEEPEST_DEG = 15.0
"""Maximum angle between up and the z axis of the poses, in degrees."""
TILE_M = 10.0
"""Edge of the tiles in which blocks are found, in metres."""
PosedPoints = tuple[Float[np.ndarray, "4 4"], Float[np.ndarray, "_ 3"]]
"""Pose of a scan, and its points in the LiDAR frame."""


def point_cloud(
    recordings: Sequence[Recording],
    poses: Sequence[ArrayLike],
    *,
    config: CloudConfig = CloudConfig(),
    on_bad_scan: OnBadScan | None = None,
    on_progress: Callable[[int], None] = lambda done: None,
) -> Float[np.ndarray, "n 3"]:
    """Return the points of recordings in the frame of their poses, in metres, without moving objects. z is up.

    Arguments:
      recordings: The scans.
      poses: Pose of the LiDAR at each scan of each recording, in one frame.
      config: Voxels, reach and moving objects.
      on_bad_scan: Called with id and error of an unreadable scan. By default, the error is raised.
      on_progress: Called with the number of scans read. Every scan is read twice, unless moving objects are kept.

    Raises:
      ValueError: If a recording has images or another number of poses, or if no scan has points.
      TypeError: If an argument is not a recording or an array.
    """
    if not len(recordings) or isinstance(recordings, Recording) or len(recordings) != len(poses):
        raise ValueError("expected a list of recordings and a list with the poses of each, found other arguments")
    for recording in recordings:
        check_is(recording, Recording, by="open_recording")
        recording.require_scans()
    poses = [as_scan_poses(each, recording, of="poses") for each, recording in zip(poses, recordings, strict=True)]
    for recording, recording_poses in zip(recordings, poses, strict=True):
        _warn_of_tilt(recording, recording_poses)
    done = 0

    def scans(report: OnBadScan | None) -> Iterator[PosedPoints]:
        """Yield the pose of each used scan, relative to the origin, and its points in the LiDAR frame."""
        nonlocal done
        for recording, world_from_lidar in zip(recordings, poses, strict=True):
            rows = _spaced(world_from_lidar[:, :3, 3], config.spacing_m)
            before = done
            for row, points in scan_stream(
                recording, lambda row, scan: _near(scan, config.reach_m), rows=rows, ahead=2, on_bad_scan=report
            ):
                if points is not None and len(points):
                    yield shift @ world_from_lidar[row], points
                on_progress(before + row + 1)
            done = before + len(recording)

    origin = np.round(poses[0][0, :3, 3]) if len(poses[0]) else np.zeros(3)
    shift = np.eye(4)
    shift[:3, 3] = -origin
    cloud, blocks = VoxelCloud(config.voxel_m), _Blocks()
    for origin_from_lidar, points in scans(on_bad_scan):
        moved = transformed(origin_from_lidar, points).astype(np.float32)
        blocks.add(moved)
        cloud.add(moved)
    stored = cloud.points
    if not len(stored):
        raise ValueError(f"{recordings[0].name}: expected scans with points, found none")
    if not config.keep_moving:
        again = scans(on_bad_scan and (lambda scan, error: None))  # bad scans have been reported
        stored = stored[~blocks.are_moving(stored, again) | (height_above_ground(stored) < GROUND_M)]
    return stored + origin


def _warn_of_tilt(recording: Recording, world_from_lidar: Float[np.ndarray, "n 4 4"]) -> None:
    """Issue a `DataWarning` if up is not nearly the z axis of the poses, on which ground and grid rest."""
    ups = np.einsum("nij,nj->ni", world_from_lidar[:, :3, :3], recording.uprights[:, 2, :3])
    x, y, z = ups.mean(axis=0) if len(ups) else (0.0, 0.0, 1.0)
    tilt_deg = np.degrees(np.arctan2(np.hypot(x, y), z))
    if tilt_deg > STEEPEST_DEG:
        found = f"found up tilted by {tilt_deg:.0f} degrees; its ground is not recognised"
        warn(f"{recording.name}: expected poses with z up, {found}")


def _near(scan: Scan, reach_m: float) -> Float[np.ndarray, "m 3"]:
    """Return the points of a scan within reach, in the LiDAR frame."""
    points = scan.cloud.astype(np.float64)
    squared = np.einsum("ni,ni->n", points, points)
    return points[(squared > 0) & (squared <= reach_m**2)]  # not for NaN


def _spaced(positions: Float[np.ndarray, "n 3"], spacing_m: float) -> list[int]:
    """Return the rows at least `spacing_m` from the row returned before."""
    rows = list[int]()
    for row, position in enumerate(positions):
        if not rows or np.linalg.norm(position - positions[rows[-1]]) >= spacing_m:
            rows.append(row)
    return rows


def _tile_numbers(points: Float[np.ndarray, "n 3"]) -> Int64[np.ndarray, " n"]:
    """Return the number of the tile of each point. A tile has all heights."""
    return voxel_numbers(points * [1, 1, 0], TILE_M)


class _Blocks:
    """Blocks of space, and the number of scans with a point in each."""

    def __init__(self):
        self._numbers, self._hits = np.zeros(0, np.int64), np.zeros(0, np.int64)
        self._pending = list[np.ndarray]()

    def add(self, points: Float[np.ndarray, "n 3"]) -> None:
        """Count the blocks of a scan, given its points in the world."""
        self._pending.append(np.unique(voxel_numbers(points, BLOCK_M)))
        if sum(map(len, self._pending)) > len(self._numbers):
            self._merge()

    def _merge(self) -> None:
        numbers = np.concatenate([self._numbers, *self._pending])
        hits = np.concatenate([self._hits, *(np.ones(len(scan), np.int64) for scan in self._pending)])
        self._numbers, rows = np.unique(numbers, return_inverse=True)
        self._hits = np.bincount(rows, weights=hits, minlength=len(self._numbers)).astype(np.int64)
        self._pending = []

    def are_moving(self, points: Float[np.ndarray, "n 3"], scans: Iterable[PosedPoints]) -> Bool[np.ndarray, " n"]:
        """Return whether each point of the cloud is in a block that more scans see through than have a point in.

        At least `LEAST_SEEN` scans must see through it. Up to `LAYERS` blocks above it move, too, if no more scans have
        a point in them. `scans` yields poses and points in the LiDAR frame.
        """
        self._merge()
        block_of_point = np.searchsorted(self._numbers, voxel_numbers(points, BLOCK_M))
        size = np.bincount(block_of_point, minlength=len(self._numbers))  # 0 if other blocks have the voxels' points
        sums = [np.bincount(block_of_point, weights=axis, minlength=len(size)) for axis in points.T]
        centres = np.stack(sums, axis=1) / size.clip(1)[:, None]  # of the points: a surface fills a part of its block
        tile_of_block = _tile_numbers(centres)
        order = np.argsort(tile_of_block, kind="stable")
        tiles, starts = np.unique(tile_of_block[order], return_index=True)
        rows_of_tile = dict(zip(tiles.tolist(), np.split(order, starts[1:]), strict=True))
        reach_tiles = np.arange(-np.ceil(SEEN_REACH_M / TILE_M), np.ceil(SEEN_REACH_M / TILE_M) + 1) * TILE_M
        around = np.stack(np.meshgrid(reach_tiles, reach_tiles, [0.0]), axis=-1).reshape(-1, 3)
        seen = np.zeros(len(centres), np.int64)
        for origin_from_lidar, scan_points in scans:
            position = origin_from_lidar[:3, 3]
            near = [rows_of_tile.get(tile, order[:0]) for tile in _tile_numbers(position + around).tolist()]
            rows = np.concatenate(near)
            seen[rows[_seen_through(scan_points, (centres[rows] - position) @ origin_from_lidar[:3, :3])]] += 1
        is_moving = (size > 0) & (seen >= LEAST_SEEN) & (seen > self._hits)
        below = np.searchsorted(self._numbers, self._numbers - ABOVE)
        has_below = self._numbers[below] == self._numbers - ABOVE
        for _ in range(LAYERS):  # the sky returns no points, so no scan sees through upper parts
            is_moving |= has_below & is_moving[below] & (self._hits <= self._hits[below])
        return is_moving[block_of_point]


def _seen_through(points: Float[np.ndarray, "n 3"], centres: Float[np.ndarray, "m 3"]) -> Bool[np.ndarray, " m"]:
    """Return whether a scan has points behind each block, and none in front, in the pixels around its direction."""
    columns, rows = round(360 / PIXEL_DEG), round(180 / PIXEL_DEG)
    nearest_m = np.full(rows * columns, np.inf)
    pixels, ranges = _pixels(points)
    np.minimum.at(nearest_m, pixels, ranges)
    nearest_m = minimum_filter1d(nearest_m.reshape(rows, columns), 3, axis=0, mode="nearest")
    around = minimum_filter1d(nearest_m, 3, axis=1, mode="wrap").reshape(-1)
    pixels, ranges = _pixels(centres)
    nearest = around[pixels]
    return (ranges < SEEN_REACH_M) & np.isfinite(nearest) & (nearest > ranges + BEHIND_M)


def _pixels(points: Float[np.ndarray, "n 3"]) -> tuple[Int64[np.ndarray, " n"], Float[np.ndarray, " n"]]:
    """Return the number of the pixel of each point, and its range in metres."""
    columns, rows = round(360 / PIXEL_DEG), round(180 / PIXEL_DEG)
    x, y, z = points.T
    ranges = np.sqrt(x * x + y * y + z * z).clip(1e-6)
    column = ((np.degrees(np.arctan2(y, x)) + 180) / PIXEL_DEG).astype(np.int64) % columns
    row = ((np.degrees(np.arcsin((z / ranges).clip(-1, 1))) + 90) / PIXEL_DEG).astype(np.int64).clip(max=rows - 1)
    return row * columns + column, ranges
