"""Submaps: the scans of the last metres of a drive, merged in the frame of the newest scan.

A sensor with a narrow field of view sees more in several scans than in one. A submap holds the nearest point of each
direction, as a scan does, because the weights are trained on scans (docs/decisions.md).
"""

import dataclasses
import hashlib
import math
from collections import deque
from collections.abc import Sequence
from functools import lru_cache
from pathlib import Path

import numpy as np
from jaxtyping import Float, Float32, Int, UInt64

from sglpr_jax.data.poses import as_poses, as_scan_poses
from sglpr_jax.data.recording import Recording
from sglpr_jax.data.scan import Scan, check_cloud
from sglpr_jax.files import warn

LENGTH_M, KEYFRAME_M = 10.0, 1.0
"""Default travelled distance that a submap covers, and default distance between its scans, in metres."""
KEYFRAME_DEG = 20.0
"""Rotation since the last keyframe after which a scan is a keyframe, in degrees, at any distance."""
KEYFRAMES_PER_TURN = 18
"""Number of keyframes of a sensor that turns once in place."""
VOXEL_M = 0.1
"""Edge of the voxels of a stored scan, in metres. Each voxel holds one point."""
DIRECTION_DEG = 0.4
"""Edge of the cells of azimuth and elevation of a submap, in degrees. Each cell holds its nearest point."""
AZIMUTHS = round(360 / DIRECTION_DEG)
"""Number of cells in a revolution."""
ROW_BITS = 22
"""Number of bits for the row of a point in a sorted key. A submap has at most 4 million points before it is thinned."""
VOXEL_OFFSET = 2**13
"""Number added to voxel numbers to make them positive. Points farther away than this number of voxels are dropped."""
NEAREST_M = 0.001
"""Minimum largest coordinate of a point, in metres. Drivers write zeros for rays without an echo."""
DISTANCE_BITS = 20
"""Number of bits for a distance in steps of 2 mm, up to 2 km."""
SUBMAPS = "submaps"
"""Name of the read option that describes the submaps of a recording."""


class SubmapBuilder:
    """Builds the submap of each scan of a stream, from keyframes at least `keyframe_m` or 20 degrees apart.

    A builder stores at most `length_m / keyframe_m` + 19 scans, with one point per voxel.

    Example:
      builder = sglpr_jax.SubmapBuilder(length_m=10.0)
      for points, pose in stream:
          detector.add(builder.add(points, pose), odometry=pose)
    """

    def __init__(self, *, length_m: float = LENGTH_M, keyframe_m: float = KEYFRAME_M):
        """Create a builder of submaps of `length_m` metres of path. Raises ValueError if a length is not positive."""
        self._window = _KeyframeWindow(length_m, keyframe_m)
        self._scans: dict[int, tuple[Scan, Float[np.ndarray, "4 4"]]] = {}

    def add(
        self, points: Float32[np.ndarray, "n 3"], world_from_lidar: Float[np.ndarray, "4 4"]
    ) -> Float32[np.ndarray, "m 3"]:
        """Add a scan. Returns the points of its submap, in the frame of this scan.

        Arguments:
          points: Points of the scan in the LiDAR frame, in metres.
          world_from_lidar: Pose of the LiDAR in a fixed frame. It may drift.

        Raises ValueError if `check_cloud` rejects the points, or if the pose has no rotation.
        """
        check_cloud(points)
        (pose,) = as_poses([world_from_lidar], of="world_from_lidar")
        newest, *older = self._window.add(pose)
        older_scans = {frame: self._scans[frame] for frame in older}
        self._scans = {newest: (_one_point_per_voxel(Scan(points=points)), pose), **older_scans}
        scans, poses = zip(*self._scans.values(), strict=True)
        return _merged(scans, poses).cloud


def submaps(
    recording: Recording,
    world_from_lidar: Float[np.ndarray, "n 4 4"],
    *,
    length_m: float = LENGTH_M,
    keyframe_m: float = KEYFRAME_M,
) -> Recording:
    """Return a recording whose scan i is the submap that ends at scan i, in the frame of scan i.

    Submaps are built when they are read. An older scan that cannot be read is left out, with a `DataWarning`.

    Arguments:
      recording: Recording of scans.
      world_from_lidar: Pose of the LiDAR at each scan, from odometry or a map. Drift within `length_m` blurs submaps.
      length_m: Travelled distance that a submap covers, in metres. 0 returns the recording unchanged.
      keyframe_m: Minimum distance between the scans of a submap, in metres.

    Raises ValueError if a length is not positive, or if the poses do not fit the scans.

    Example:
      recording = sglpr_jax.submaps(recording, sglpr_jax.read_odometry("odometry.tum"), length_m=10.0)
    """
    if length_m == 0:
        return recording
    window = _KeyframeWindow(length_m, keyframe_m)
    recording.require_scans("scans for submaps")
    poses = as_scan_poses(world_from_lidar, recording, of="poses")
    rows_of_submap = [window.add(pose) for pose in poses]

    @lru_cache(maxsize=max(map(len, rows_of_submap), default=1))  # the scans of one submap
    def read_thinned(row: int, labels: bool) -> Scan:
        scan = recording.scan(row, labels=labels)
        check_cloud(scan.cloud, name=scan.name)
        if labels and scan.labels is None:
            scan = dataclasses.replace(scan, labels=np.zeros(len(scan.cloud), np.int32))
        return _one_point_per_voxel(scan)

    def read_submap(row: int, label_path: Path | None) -> Scan:
        newest, *older = rows_of_submap[row]
        scans = {newest: read_thinned(newest, label_path is not None)}
        for keyframe in older:
            try:
                scans[keyframe] = read_thinned(keyframe, label_path is not None)
            except (ValueError, OSError) as error:
                warn(f"{recording.ids[keyframe]}: left out of the submaps of later scans: {error}")
        submap = _merged(list(scans.values()), [poses[keyframe] for keyframe in scans])
        return dataclasses.replace(submap, labels_file=label_path)

    digest = hashlib.sha256(poses.tobytes()).hexdigest()[:16]
    note = f"submaps: the scans of the last {length_m:g} m, {keyframe_m:g} m apart, in the frame of the newest scan"
    options = {SUBMAPS: f"{length_m:g} {keyframe_m:g} {digest}"}
    return recording.with_reader(read_submap, options=options).with_note(note)


class _KeyframeWindow:
    """Selects the frames of each submap: keyframes within the last `length_m` metres of a drive."""

    def __init__(self, length_m: float, keyframe_m: float):
        for name, value in (("length_m", length_m), ("keyframe_m", keyframe_m)):
            if not (math.isfinite(value) and value > 0):
                raise ValueError(f"submaps: expected {name} in metres, more than 0, found {value}")
        self._length_m, self._keyframe_m = length_m, keyframe_m
        self._frames = 0
        most = math.ceil(length_m / keyframe_m) + KEYFRAMES_PER_TURN
        self._keyframes: deque[tuple[int, float]] = deque(maxlen=most)
        """Frame number and travelled distance in metres of each keyframe in the window."""
        self._last: tuple[float, Float[np.ndarray, "4 4"]] | None = None
        """Travelled distance in metres and pose of the last keyframe, also if it left the window."""

    def add(self, pose: Float[np.ndarray, "4 4"]) -> tuple[int, ...]:
        """Add the next frame. Returns its number, then those of the keyframes in the window, the newest first."""
        frame = self._frames
        self._frames += 1
        step_m, turn_deg, path_m = math.inf, 0.0, 0.0  # the first frame is a keyframe
        if self._last is not None:
            last_path_m, last_pose = self._last
            step_m, turn_deg = _distance_and_angle(last_pose, pose)
            path_m = last_path_m + step_m
        while self._keyframes and path_m - self._keyframes[0][1] > self._length_m:
            self._keyframes.popleft()  # for good: a return to the last keyframe decreases `path_m`
        in_window = [row for row, _ in reversed(self._keyframes)]
        if step_m >= self._keyframe_m or turn_deg >= KEYFRAME_DEG:
            self._keyframes.append((frame, path_m))
            self._last = path_m, pose
        return (frame, *in_window)


def _distance_and_angle(a: Float[np.ndarray, "4 4"], b: Float[np.ndarray, "4 4"]) -> tuple[float, float]:
    """Distance in metres and angle of rotation in degrees between two poses."""
    cosine = (np.sum(a[:3, :3] * b[:3, :3]) - 1) / 2
    return float(np.linalg.norm(b[:3, 3] - a[:3, 3])), math.degrees(math.acos(np.clip(cosine, -1, 1)))


def _merged(scans: Sequence[Scan], poses: Sequence[Float[np.ndarray, "4 4"]]) -> Scan:
    """Merge scans in the frame of the first one. Of each cell of azimuth and elevation, the nearest point is kept."""
    rotation, position = poses[0][:3, :3], poses[0][:3, 3]
    others = [
        (scan.cloud @ (rotation.T @ pose[:3, :3]).T + rotation.T @ (pose[:3, 3] - position)).astype(np.float32)
        for scan, pose in zip(scans[1:], poses[1:], strict=True)
    ]
    labels = [scan.labels for scan in scans if scan.labels is not None]
    points = np.concatenate([scans[0].cloud, *others])
    x, y, z = points.T
    distance = np.sqrt(x * x + y * y + z * z)
    cells_per_radian = np.float32(AZIMUTHS / (2 * np.pi))
    azimuth = np.floor(np.arctan2(y, x) * cells_per_radian).astype(np.int64) + AZIMUTHS
    elevation = np.floor(np.arctan2(z, np.hypot(x, y)) * cells_per_radian).astype(np.int64) + AZIMUTHS
    cell = (elevation * 2 * AZIMUTHS + azimuth).astype(np.uint64)
    steps_of_2_mm = (distance * 500).clip(max=2**DISTANCE_BITS - 1).astype(np.uint64)
    merged = Scan(points=points, labels=np.concatenate(labels) if labels else None)
    return merged.only(_rows_of_smallest(cell << np.uint64(DISTANCE_BITS) | steps_of_2_mm, ignored_bits=DISTANCE_BITS))


def _one_point_per_voxel(scan: Scan) -> Scan:
    """The first point of each voxel. Points that are not finite, at the sensor or more than 819 m away are dropped."""
    with np.errstate(over="ignore", invalid="ignore"):
        largest_m = np.abs(scan.cloud).max(axis=1)
        is_measured = (largest_m > NEAREST_M) & (largest_m < (VOXEL_OFFSET - 1) * VOXEL_M)  # False for NaN
    rows = np.flatnonzero(is_measured)
    x, y, z = (np.floor(scan.cloud[rows].T / np.float32(VOXEL_M)) + VOXEL_OFFSET).astype(np.uint64)
    voxels_per_axis = np.uint64(2 * VOXEL_OFFSET)
    return scan.only(rows[_rows_of_smallest((z * voxels_per_axis + y) * voxels_per_axis + x, ignored_bits=0)])


def _rows_of_smallest(keys: UInt64[np.ndarray, " n"], *, ignored_bits: int) -> Int[np.ndarray, " m"]:
    """Row of the smallest key in each group of keys that are equal without their last bits, in ascending order.

    Sorting keys that contain the row is ten times as fast as np.unique. Keys have at most 42 bits.
    """
    keys = keys[: 2**ROW_BITS]  # drops the oldest scans of a submap, which come last
    keys_with_rows = np.sort(keys << np.uint64(ROW_BITS) | np.arange(len(keys), dtype=np.uint64))
    groups = keys_with_rows >> np.uint64(ROW_BITS + ignored_bits)
    is_smallest = np.diff(groups, prepend=np.uint64(2**64 - 1)) != 0  # the first of its group
    return np.sort(keys_with_rows[is_smallest] & np.uint64(2**ROW_BITS - 1)).astype(np.int64)
