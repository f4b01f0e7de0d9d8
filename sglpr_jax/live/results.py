"""Files of a live map for other programs, written when the node ends."""

from pathlib import Path

import numpy as np

from sglpr_jax.files import write_all
from sglpr_jax.live.corrected import CorrectedTrajectory
from sglpr_jax.live.live_map import LiveMap
from sglpr_jax.pose_graph.files import write_g2o, write_loops_csv, write_rejected_jsonl, write_tum

GRAPH, TABLE, REJECTED = "loops.g2o", "loops.csv", "rejected.jsonl"
TRAJECTORY, CORRECTED = "trajectory.tum", "trajectory-optimized.tum"


def write_results(live: LiveMap, folder: Path, *, corrected: CorrectedTrajectory | None = None) -> list[Path]:
    """Write the loops as g2o and csv, the rejected pairs, and the odometry as tum, if there is any.

    With `corrected`, write its trajectory, too, without parts that no loop connects with the first one.

    The graph has no edge between scans whose motion is unknown, as before and after a restart. Returns the paths.
    Raises WriteError if a file cannot be written.
    """
    detector, loops, odometry = live.detector, live.detector.loops, live.odometry
    segments = detector.finder.motion.segments
    parts = np.split(np.arange(len(odometry)), np.flatnonzero(np.diff(segments)) + 1) if len(odometry) else []
    files = {
        GRAPH: lambda path: write_g2o(
            path, loops, [(rows, odometry[rows]) for rows in parts], drift=detector.config.drift
        ),
        TABLE: lambda path: write_loops_csv(path, loops),
        REJECTED: lambda path: write_rejected_jsonl(path, detector.rejected),
    }
    if len(odometry):
        files[TRAJECTORY] = lambda path: write_tum(path, odometry, live.stamps)
    if len(odometry) and corrected is not None:
        known = np.isfinite(poses := corrected.poses).all(axis=(1, 2))
        files[CORRECTED] = lambda path: write_tum(path, poses[known], live.stamps[known])
    return write_all(folder, files)
