"""Files that the live node writes at its end for other programs: loops, rejected pairs and trajectories."""

from functools import partial
from pathlib import Path

import numpy as np

from sglpr_jax.files import write_all
from sglpr_jax.live.live_map import LiveMap
from sglpr_jax.pose_graph.files import LOOPS_JSONL, write_tum
from sglpr_jax.pose_graph.folder import LOOPS_CSV, LOOPS_G2O, REJECTED, graph_files

TRAJECTORY, CORRECTED = "trajectory.tum", "trajectory-optimized.tum"
RESULTS = (LOOPS_JSONL, LOOPS_G2O, LOOPS_CSV, REJECTED, TRAJECTORY, CORRECTED)
"""Names of all files of `write_results`."""


def write_results(live: LiveMap, folder: Path) -> list[Path]:
    """Write the loops as g2o, csv and JSON lines, the rejected pairs, and the odometry and its correction as tum, if
    there is any. The JSON lines replace those of `LiveMap`, which may lack loops after an error of the disk.

    The graph has no edge between scans whose motion is unknown, such as before and after a restart. The corrected
    trajectory lacks the parts that loops do not connect with the first one. Returns the paths. Raises
    WriteError if a file cannot be written.
    """
    detector, odometry = live.detector, live.odometry
    chains = []
    if len(odometry):
        scans = np.arange(len(odometry))
        segment_starts = np.flatnonzero(np.diff(detector.finder.segments_of(scans))) + 1  # where the motion is unknown
        segments = np.split(scans, segment_starts)
        chains = [(frames, odometry[frames], detector.config.drift) for frames in segments]
    files = graph_files(live.loops, [*detector.rejected, *detector.undecided()], chains)
    if len(odometry):
        files[TRAJECTORY] = partial(write_tum, poses=odometry, times=live.stamps)
        if live.trajectory is not None:
            poses = live.trajectory.poses
            connected = np.isfinite(poses).all(axis=(1, 2))
            files[CORRECTED] = partial(write_tum, poses=poses[connected], times=live.stamps[connected])
    return write_all(folder, files)
