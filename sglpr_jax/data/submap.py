"""Submaps: the scans of the last metres of a drive, merged in the frame of the newest scan.

A narrow sensor sees more of a place in several scans than in one. A submap holds the nearest point of each direction,
as a scan does, because the weights are trained on scans (docs/decisions.md).
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

from sglpr_jax.data.poses import checked_poses, checked_scan_poses
from sglpr_jax.data.recording import Recording
from sglpr_jax.data.scan import Scan, check_cloud
from sglpr_jax.files import warn

LENGTH_M, KEYFRAME_M = 10.0, 1.0
"""Default travelled distance that a submap covers, and default distance between its scans, in metres."""
KEYFRAME_DEG = 20.0
"""Rotation after which a scan is a keyframe, in degrees, at any distance."""
TURN = 18
"""Number of further keyframes of a sensor that turns in place: a full turn."""
VOXEL_M = 0.1
"""Edge of the voxels of a stored scan, in metres. Each voxel holds one point."""
DIRECTION_DEG = 0.4
"""Edge of a direction of a submap, in degrees of azimuth and elevation. Each direction holds its nearest point."""
AZIMUTHS = round(360 / DIRECTION_DEG)
"""Number of directions in a revolution."""
INDEX_BITS = 22
"""Bits of the number of a point in a sorted key. A submap has at most 4 million points before it is thinned."""
HALF = 2**13
"""Offset of voxel numbers, which makes them positive. Points more than `HALF` voxels from the sensor are dropped."""
SUBMAPS = "submaps"
"""Name of the read option that describes the submaps of a recording."""


class SubmapBuilder:
    """Builds the submap of each scan of a stream, from keyframes at least `keyframe_m` or 20 degrees apart.

    Its memory is bounded by `length_m / keyframe_m` + 19 scans of one point per voxel.

    Example:
      builder = sglpr_jax.SubmapBuilder(length_m=10.0)
      for points, pose in stream:
          detector.add(builder.add(points, pose), odometry=pose)
    """

    def __init__(self, *, length_m: float = LENGTH_M, keyframe_m: float = KEYFRAME_M):
        """Create a builder of submaps of `length_m` metres of path, of scans at least `keyframe_m` metres apart."""
        self._window = _Window(length_m, keyframe_m)
        self._scans: dict[int, tuple[Scan, Float[np.ndarray, "4 4"]]] = {}

    def add(
        self, points: Float32[np.ndarray, "n 3"], world_from_lidar: Float[np.ndarray, "4 4"]
    ) -> Float32[np.ndarray, "m 3"]:
        """Add a scan. Returns the points of its submap, in the frame of this scan.

        Arguments:
          points: Points of the scan in the LiDAR frame, in metres.
          world_from_lidar: Pose of the LiDAR in a fixed frame. It may drift.

        Raises ValueError if the scan shows no place (`check_cloud`), or if the pose has no rotation.
        """
        check_cloud(points)
        pose = checked_poses(np.asarray(world_from_lidar, np.float64)[None], use=SUBMAPS)[0]
        newest, *older = self._window.add(pose)
        self._scans = {newest: (_thinned(Scan(points=points)), pose), **{row: self._scans[row] for row in older}}
        return _merged(*zip(*self._scans.values(), strict=True)).cloud


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
      world_from_lidar: Pose of the LiDAR at each scan, from odometry or a map. Drift within `length_m` blurs it.
      length_m: Travelled distance that a submap covers, in metres. 0 returns the recording unchanged.
      keyframe_m: Minimum distance between the scans of a submap, in metres.

    Raises ValueError if a length is not positive, or if the poses do not fit the scans.

    Example:
      recording = sglpr_jax.submaps(recording, sglpr_jax.read_odometry("odometry.tum"), length_m=10.0)
    """
    if length_m == 0:
        return recording
    window = _Window(length_m, keyframe_m)
    poses = checked_scan_poses(recording, world_from_lidar, use=SUBMAPS)
    members = [window.add(pose) for pose in poses]

    @lru_cache(maxsize=max(map(len, members), default=1))
    def thinned(row: int, labelled: bool) -> Scan:
        scan = recording.scan(row, labels=labelled)
        check_cloud(scan.cloud, name=scan.name)
        if labelled and scan.labels is None:
            scan = dataclasses.replace(scan, labels=np.zeros(len(scan.cloud), np.int32))
        return _thinned(scan)

    def read(row: int, label_path: Path | None, lasers: bool) -> Scan:
        """Read a submap. Submaps have no laser numbers."""
        newest, *older = members[row]
        scans = {newest: thinned(newest, label_path is not None)}
        for keyframe in older:
            try:
                scans[keyframe] = thinned(keyframe, label_path is not None)
            except (ValueError, OSError) as error:
                warn(f"{recording.ids[keyframe]}: left out of the submaps of later scans: {error}")
        submap = _merged(list(scans.values()), [poses[keyframe] for keyframe in scans])
        return dataclasses.replace(submap, labels_file=label_path)

    digest = hashlib.sha256(poses.tobytes()).hexdigest()[:16]
    note = f"submaps: the scans of the last {length_m:g} m, {keyframe_m:g} m apart, in the frame of the newest scan"
    return recording.with_reader(read, options={SUBMAPS: f"{length_m:g} {keyframe_m:g} {digest}"}).with_note(note)


class _Window:
    """Keyframes within the last `length_m` metres of a drive."""

    def __init__(self, length_m: float, keyframe_m: float):
        for name, value in (("length_m", length_m), ("keyframe_m", keyframe_m)):
            if not (math.isfinite(value) and value > 0):
                raise ValueError(f"submaps: expected {name} in metres, more than 0, found {value}")
        self._length_m, self._keyframe_m = length_m, keyframe_m
        self._frames, self._path_m = 0, 0.0
        most = math.ceil(length_m / keyframe_m) + TURN
        self._keyframes: deque[tuple[int, float]] = deque(maxlen=most)
        self._last: Float[np.ndarray, "4 4"] | None = None

    def add(self, pose: Float[np.ndarray, "4 4"]) -> tuple[int, ...]:
        """Add the next frame. Returns its number and those of the keyframes before it, the newest first."""
        frame, self._frames = self._frames, self._frames + 1
        step_m, turn_deg = (math.inf, 0.0) if self._last is None else _motion(self._last, pose)
        path_m = self._path_m + step_m if self._keyframes else 0.0
        rows = (frame, *(row for row, at_m in reversed(self._keyframes) if path_m - at_m <= self._length_m))
        if step_m >= self._keyframe_m or turn_deg >= KEYFRAME_DEG:
            self._keyframes.append((frame, path_m))
            self._path_m, self._last = path_m, pose
        return rows


def _motion(before: Float[np.ndarray, "4 4"], after: Float[np.ndarray, "4 4"]) -> tuple[float, float]:
    """Distance in metres and rotation in degrees between two poses."""
    cosine = (np.sum(before[:3, :3] * after[:3, :3]) - 1) / 2
    return float(np.linalg.norm(after[:3, 3] - before[:3, 3])), math.degrees(math.acos(np.clip(cosine, -1, 1)))


def _merged(scans: Sequence[Scan], poses: Sequence[Float[np.ndarray, "4 4"]]) -> Scan:
    """One scan in the frame of the first one, with the nearest point of each direction."""
    rotation, position = poses[0][:3, :3], poses[0][:3, 3]
    moved = [
        (scan.cloud @ (rotation.T @ pose[:3, :3]).T + rotation.T @ (pose[:3, 3] - position)).astype(np.float32)
        for scan, pose in zip(scans[1:], poses[1:], strict=True)
    ]
    labels = [scan.labels for scan in scans if scan.labels is not None]
    points = np.concatenate([scans[0].cloud, *moved])
    x, y, z = points.T
    distance = np.sqrt(x * x + y * y + z * z)
    scale = np.float32(AZIMUTHS / (2 * np.pi))
    azimuth = np.floor(np.arctan2(y, x) * scale).astype(np.int64) + AZIMUTHS
    elevation = np.floor(np.arctan2(z, np.hypot(x, y)) * scale).astype(np.int64) + AZIMUTHS
    direction = (elevation * 2 * AZIMUTHS + azimuth).astype(np.uint64)
    keys = direction << np.uint64(20) | (distance * 500).clip(max=2**20 - 1).astype(np.uint64)
    merged = Scan(points=points, labels=np.concatenate(labels) if labels else None)
    return merged.only(_first_of(keys, shift=20))


def _thinned(scan: Scan) -> Scan:
    """The first point of each voxel. Points that are not finite are dropped."""
    with np.errstate(over="ignore", invalid="ignore"):
        inside = np.flatnonzero((np.abs(scan.cloud) < (HALF - 1) * VOXEL_M).all(axis=1))  # false for NaN
    x, y, z = (np.floor(scan.cloud[inside].T / np.float32(VOXEL_M)) + HALF).astype(np.uint64)
    return scan.only(inside[_first_of((z * np.uint64(2 * HALF) + y) * np.uint64(2 * HALF) + x, shift=0)])


def _first_of(keys: UInt64[np.ndarray, " n"], *, shift: int) -> Int[np.ndarray, " m"]:
    """Row of the smallest of the keys that are equal but for their last `shift` bits, in the order of the rows.

    Sorting keys that contain the row is ten times as fast as np.unique. Keys have at most 42 bits.
    """
    keys = keys[: 2**INDEX_BITS]  # the newest scans come first
    order = np.sort(keys << np.uint64(INDEX_BITS) | np.arange(len(keys), dtype=np.uint64))
    first = np.diff(order >> np.uint64(INDEX_BITS + shift), prepend=np.uint64(2**64 - 1)) != 0
    return np.sort(order[first] & np.uint64(2**INDEX_BITS - 1)).astype(np.int64)
