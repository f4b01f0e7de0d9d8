"""Results of a live map: the trajectory that its loops correct after each scan, and files for other programs."""

from collections import deque
from functools import partial
from pathlib import Path

import numpy as np
from jaxtyping import Float

from sglpr_jax.files import write_all
from sglpr_jax.live.live_map import LiveMap
from sglpr_jax.live.messages import Report
from sglpr_jax.pose_graph.files import write_tum
from sglpr_jax.pose_graph.folder import graph_files
from sglpr_jax.pose_graph.incremental import IncrementalTrajectory

TRAJECTORY, CORRECTED = "trajectory.tum", "trajectory-optimized.tum"


class CorrectedTrajectory:
    """Follows a `LiveMap`: `update` takes its new scans and loops."""

    def __init__(self, live: LiveMap):
        """Create the trajectory of a map. Raises ImportError if gtsam is not installed."""
        self._live, self._trajectory = live, IncrementalTrajectory(drift=live.detector.config.drift)
        self._loops = 0

    @property
    def map_from_world(self) -> Float[np.ndarray, "4 4"] | None:
        """Correction of the odometry at the last scan. None without odometry, and while no loop connects the odometry
        with that before a restart."""
        return self._trajectory.map_from_world if len(self._trajectory) else None

    @property
    def poses(self) -> Float[np.ndarray, "n 4 4"]:
        """Corrected poses. NaN in parts that no loop connects with the first one."""
        return self._trajectory.poses

    def update(self) -> None:
        """Take the scans and loops since the last call."""
        poses, segments = self._live.odometry, self._live.detector.finder.motion.segments
        loops = deque(sorted(self._live.detector.loops[self._loops :], key=lambda loop: loop.query))
        self._loops += len(loops)
        for frame in range(len(self._trajectory), len(poses)):
            known = []
            while loops and loops[0].query <= frame:
                known.append(loops.popleft())
            continues = frame == 0 or segments[frame] == segments[frame - 1]
            self._trajectory.add(poses[frame], known, continues=bool(continues))


def corrected_trajectory(live: LiveMap, *, odometry: bool, report: Report) -> CorrectedTrajectory | None:
    """Create the trajectory of a map with odometry. Without gtsam, report a line and return None."""
    if not odometry:
        return None
    try:
        return CorrectedTrajectory(live)
    except ImportError as error:
        report("gtsam", f"the map has no transform from map to odometry: {error}")
        return None


def write_results(live: LiveMap, folder: Path, *, corrected: CorrectedTrajectory | None = None) -> list[Path]:
    """Write the loops as g2o and csv, the rejected pairs, and the odometry and its correction as tum, if there is any.

    The graph has no edge between scans whose motion is unknown, as before and after a restart. The correction lacks
    parts that no loop connects with the first one. Returns the paths. Raises WriteError if a file cannot be written.
    """
    detector, odometry = live.detector, live.odometry
    segments = detector.finder.motion.segments
    parts = np.split(np.arange(len(odometry)), np.flatnonzero(np.diff(segments)) + 1) if len(odometry) else []
    driven = [(rows, odometry[rows]) for rows in parts]
    files = graph_files(detector.loops, detector.rejected, driven, drift=detector.config.drift)
    if len(odometry):
        files[TRAJECTORY] = partial(write_tum, poses=odometry, times=live.stamps)
    if len(odometry) and corrected is not None:
        known = np.isfinite(poses := corrected.poses).all(axis=(1, 2))
        files[CORRECTED] = partial(write_tum, poses=poses[known], times=live.stamps[known])
    return write_all(folder, files)
