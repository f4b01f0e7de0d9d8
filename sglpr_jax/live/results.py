"""Results of a live map: the trajectory that its loops correct after each scan, and files for other programs."""

from collections import deque
from pathlib import Path

import numpy as np
from jaxtyping import Float

from sglpr_jax.live.live_map import LiveMap
from sglpr_jax.live.messages import Report
from sglpr_jax.pose_graph.files import write_joint_g2o, write_loops_csv, write_rejected_jsonl, write_tum
from sglpr_jax.pose_graph.incremental import IncrementalTrajectory

GRAPH, TABLE, REJECTED = "loops.g2o", "loops.csv", "rejected.jsonl"
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
    """Write the loops as g2o and csv, the rejected pairs, and the odometry as tum, if there is any.

    With `corrected`, write its trajectory, too, without parts that no loop connects with the first one.

    The graph has no edge between scans whose motion is unknown, as before and after a restart. Returns the paths.
    Raises WriteError if a file cannot be written.
    """
    detector, odometry = live.detector, live.odometry
    segments = detector.finder.motion.segments
    parts = np.split(np.arange(len(odometry)), np.flatnonzero(np.diff(segments)) + 1) if len(odometry) else []
    driven = [(rows, odometry[rows]) for rows in parts]
    paths = [folder / name for name in (GRAPH, TABLE, REJECTED)]
    write_joint_g2o(paths[0], detector.loops, driven, drift=detector.config.drift)
    write_loops_csv(paths[1], detector.loops)
    write_rejected_jsonl(paths[2], detector.rejected)
    if len(odometry):
        paths.append(folder / TRAJECTORY)
        write_tum(paths[-1], odometry, live.stamps)
    if len(odometry) and corrected is not None:
        known = np.isfinite(poses := corrected.poses).all(axis=(1, 2))
        paths.append(folder / CORRECTED)
        write_tum(paths[-1], poses[known], live.stamps[known])
    return paths
