"""Values that pass through the live node: scans from sources, status and loop edges to sinks."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from sglpr_jax.data.recording import Record


class LiveFrame(NamedTuple):
    """A scan as it arrives."""

    record: Record
    """Points in the LiDAR frame, with the mounting if it is known. The name of a scan from a file is unique; a scan
    whose name is in the map already is not taken again. Scans without a name are always taken."""
    time: float
    """Time of the message's header, in seconds. 0 or not finite if the header has none."""
    odometry: Float[np.ndarray, "4 4"] | None
    """Pose of the LiDAR by odometry (`world_from_lidar`), or None if it is unknown."""
    received: float
    """Time at which the scan arrived, by `time.monotonic()`, in seconds."""


class FrameStatus(NamedTuple):
    """Status after a scan was processed."""

    frame: int
    """Number of the scan in the map, from 0."""
    time: float
    """Time of the scan's header, in seconds."""
    seconds: float
    """Time for processing the scan, in seconds."""
    latency_s: float
    """Time from the arrival of the scan to the end of its processing, in seconds."""
    dropped: int
    """Number of scans that were replaced by newer ones before the node took them."""
    places: int
    """Number of stored scans."""
    nbytes: int
    """Memory of the stored scans, in bytes."""
    map_from_world: Float[np.ndarray, "4 4"] | None = None
    """Correction of the odometry by all loops so far. None without odometry or gtsam, and while no loop connects the
    odometry with that before a restart."""


class LoopEdge(NamedTuple):
    """A loop closure for a pose graph."""

    query: int
    match: int
    """Frame numbers in the map, from 0. The match is the earlier frame."""
    query_time: float
    match_time: float
    """Times of the headers of both scans, in seconds."""
    match_from_query: Float[np.ndarray, "4 4"]
    """Pose of the query's LiDAR in the frame of the match's LiDAR, in metres."""
    covariance: Float[np.ndarray, "6 6"]
    """Covariance of a small motion of the query in its own frame: x, y, z in metres, then rotations in radians."""
    probability: float
    """Probability that both scans show one place."""
    world_from_query: Float[np.ndarray, "4 4"] | None
    world_from_match: Float[np.ndarray, "4 4"] | None
    """Poses by odometry, in its present frame. None without odometry, and for scans of another odometry frame, such as
    those before a restart."""
    latency_s: float
    """Time from the arrival of the latest scan to the loop, in seconds. A loop may belong to a scan before it."""
