"""kiss-slam or MapClosures over a folder of scans, as their own pipelines do it, in an environment of their own.

python benchmarks/quality/peers/run.py kiss-slam|map-closures SCANS OUT.json
"""

import json
import sys
import tempfile
from pathlib import Path

import numpy as np


class Scans:
    """A dataset for both: points in float64, and no times within a scan."""

    sequence_id = "simulated"

    def __init__(self, folder):
        self.paths = sorted(Path(folder).glob("*.bin"))

    def __len__(self):
        return len(self.paths)

    def __getitem__(self, i):
        return np.fromfile(self.paths[i], np.float32).reshape(-1, 4)[:, :3].astype(np.float64), np.array([])


def kiss_slam(scans):
    """The trajectory (n, 4, 4), the scans of each local map and the closures."""
    from kiss_slam.config import load_config
    from kiss_slam.slam import KissSLAM

    slam = KissSLAM(load_config(None))
    for i in range(len(scans)):
        slam.process_scan(*scans[i])
    slam.generate_new_node()
    slam.local_map_graph.erase_last_local_map()
    poses, _ = slam.fine_grained_optimization()
    ends = np.cumsum([len(one.local_trajectory) - 1 for one in slam.local_map_graph.local_maps()]) + 1
    return np.array(poses), zip([0, *ends[:-1]], ends, strict=True), slam.closures


def map_closures(scans):
    """The trajectory of kiss-icp, which MapClosures does not correct, and the same."""
    from map_closures.pipeline import MapClosurePipeline

    with tempfile.TemporaryDirectory() as results:
        pipeline = MapClosurePipeline(scans, None, results)
        pipeline.run()
    data = pipeline.data
    return pipeline.odom_poses, data.local_maps_scan_index_range, [row[:2] for row in data.closures]


def main(method, folder, out):
    """Write what a method finds."""
    trajectory, maps, closures = {"kiss-slam": kiss_slam, "map-closures": map_closures}[method](Scans(folder))
    found = {
        "trajectory": trajectory.tolist(),
        "maps": [[int(first), int(end)] for first, end in maps],
        "closures": [{"source": int(source), "target": int(target)} for source, target in closures],
    }
    Path(out).write_text(json.dumps(found))


if __name__ == "__main__":
    main(*sys.argv[1:])
