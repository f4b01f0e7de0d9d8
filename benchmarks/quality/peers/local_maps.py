"""MapClosures over a folder of scans, as its own pipeline does it; run by map_closures.py in an environment of its own.

python benchmarks/quality/peers/local_maps.py SCANS OUT.json
"""

import json
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
from map_closures.pipeline import MapClosurePipeline


class Scans:
    """What MapClosures takes for a dataset: points in float64, and no times within a scan."""

    sequence_id = "simulated"

    def __init__(self, folder):
        self.paths = sorted(Path(folder).glob("*.bin"))

    def __len__(self):
        return len(self.paths)

    def __getitem__(self, i):
        return np.fromfile(self.paths[i], np.float32).reshape(-1, 4)[:, :3].astype(np.float64), np.array([])


class Timed:
    """A function that adds up its seconds."""

    def __init__(self, function):
        self.function, self.seconds = function, 0.0

    def __call__(self, *arguments):
        start = time.perf_counter()
        try:
            return self.function(*arguments)
        finally:
            self.seconds += time.perf_counter() - start


def main(folder, out):
    """Write the odometry (n, 4, 4), the scans of each local map, the closures, and seconds."""
    with tempfile.TemporaryDirectory() as results:
        pipeline = MapClosurePipeline(Scans(folder), None, results)
        odometry = pipeline.odometry.register_frame = Timed(pipeline.odometry.register_frame)
        map_of = pipeline.voxel_local_map.integrate_frame = Timed(pipeline.voxel_local_map.integrate_frame)
        closures = pipeline.map_closures.get_closures = Timed(pipeline.map_closures.get_closures)
        pipeline.run()
    found = {
        "odometry": pipeline.odom_poses.tolist(),
        "maps": [[int(first), int(end)] for first, end in pipeline.data.local_maps_scan_index_range],
        "closures": [
            {"source": int(row[0]), "target": int(row[1]), "target_from_source": row[2:].reshape(4, 4).tolist()}
            for row in pipeline.data.closures
        ],
        "seconds": {"odometry": odometry.seconds, "maps and closures": map_of.seconds + closures.seconds},
    }
    Path(out).write_text(json.dumps(found))


if __name__ == "__main__":
    main(*sys.argv[1:])
