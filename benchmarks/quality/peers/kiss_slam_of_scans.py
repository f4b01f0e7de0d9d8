"""kiss-slam over a folder of scans, as its own pipeline does it; run by slam.py in an environment of its own.

python benchmarks/quality/peers/kiss_slam_of_scans.py SCANS OUT.json
"""

import json
import sys
from pathlib import Path

import numpy as np
from kiss_slam.config import load_config
from kiss_slam.slam import KissSLAM
from local_maps import Scans


def main(folder, out):
    """Write the trajectory (n, 4, 4), the scans of each local map and the closures."""
    slam = KissSLAM(load_config(None))
    scans = Scans(folder)
    for i in range(len(scans)):
        slam.process_scan(*scans[i])
    slam.generate_new_node()
    slam.local_map_graph.erase_last_local_map()
    poses, _ = slam.fine_grained_optimization()
    ends = np.cumsum([len(one.local_trajectory) - 1 for one in slam.local_map_graph.local_maps()]) + 1
    found = {
        "trajectory": np.array(poses).tolist(),
        "maps": [[int(first), int(end)] for first, end in zip([0, *ends[:-1]], ends, strict=True)],
        "closures": [{"source": int(source), "target": int(target)} for source, target in slam.closures],
    }
    Path(out).write_text(json.dumps(found))


if __name__ == "__main__":
    main(*sys.argv[1:])
