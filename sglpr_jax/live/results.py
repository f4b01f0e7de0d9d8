"""Files of a live map for other programs, written when the node ends."""

from pathlib import Path

import numpy as np

from sglpr_jax.files import write_all
from sglpr_jax.live.live_map import LiveMap
from sglpr_jax.loops.loop_files import write_joint_g2o, write_loops_csv, write_rejected_jsonl, write_tum

GRAPH, TABLE, REJECTED, TRAJECTORY = "loops.g2o", "loops.csv", "rejected.jsonl", "trajectory.tum"


def write_results(live: LiveMap, folder: Path) -> list[Path]:
    """Write the loops as g2o and csv, the rejected pairs, and the odometry as tum, if there is any.

    The graph has no edge between scans whose motion is unknown, as before and after a restart. Returns the paths.
    Raises WriteError if a file cannot be written.
    """
    detector, loops, odometry = live.detector, live.detector.loops, live.odometry
    segments = detector.finder.motion.segments
    parts = np.split(np.arange(len(odometry)), np.flatnonzero(np.diff(segments)) + 1) if len(odometry) else []
    files = {
        GRAPH: lambda path: write_joint_g2o(
            path, loops, [(rows, odometry[rows]) for rows in parts], drift=detector.config.drift
        ),
        TABLE: lambda path: write_loops_csv(path, loops),
        REJECTED: lambda path: write_rejected_jsonl(path, detector.rejected),
    }
    if len(odometry):
        files[TRAJECTORY] = lambda path: write_tum(path, odometry, live.stamps)
    return write_all(folder, files)
