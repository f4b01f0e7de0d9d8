"""Trajectory of a live map, corrected by its loops after each scan (extra `gtsam`)."""

from collections import deque

import numpy as np
from jaxtyping import Float

from sglpr_jax.live.live_map import LiveMap
from sglpr_jax.live.report import Report
from sglpr_jax.pose_graph.incremental import IncrementalTrajectory


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
