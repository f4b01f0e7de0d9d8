"""Time and memory of `IncrementalTrajectory` on a route that is driven there and back again and again.

Almost every frame closes a loop with an earlier visit, whose error has the stated covariance.

    python -m benchmarks.speed.incremental --frames 7000
"""

import resource
import time

import numpy as np
import tyro

from sglpr_jax.loops.closure import Loop
from sglpr_jax.pose_graph.incremental import IncrementalTrajectory
from sglpr_jax.se3 import transform
from sglpr_jax.sim.recording import simulate_recording

SCANS = 240
AGO = 50
"""Minimum number of frames between the two visits of a loop."""
COVARIANCE = np.diag([0.1, 0.1, 0.5, *np.radians([2, 2, 0.3])]) ** 2


def main(*, frames: int = 7000, every: int = 1000, seed: int = 0) -> None:
    """Print a row for each part of the drive: milliseconds an update, and memory since the start.

    Args:
        frames: number of frames.
        every: frames of a row.
        seed: of the errors of the loops, and of the visits that they match.
    """
    poses, rng = simulate_recording("08", scans=SCANS, seed=3).poses.world_from_lidar, np.random.default_rng(seed)
    there_and_back = [*range(SCANS), *range(SCANS - 2, 0, -1)]
    visits: dict[int, list[int]] = {}
    trajectory, times, before = IncrementalTrajectory(), [], _megabytes()
    print("| frames | median ms | 99 % ms | MB |\n|---|---|---|---|")
    for frame in range(frames):
        place = there_and_back[frame % len(there_and_back)]
        earlier = [one for one in visits.setdefault(place, []) if frame - one > AGO]
        loops = [_loop(frame, int(rng.choice(earlier)), rng)] if earlier else []
        visits[place].append(frame)
        start = time.process_time()
        trajectory.add(poses[place], loops)
        times.append(1000 * (time.process_time() - start))
        if (frame + 1) % every == 0:
            median, most = np.percentile(times[-every:], [50, 99])
            print(f"| {frame + 1} | {median:.2f} | {most:.1f} | {_megabytes() - before:.0f} |", flush=True)


def _loop(query: int, match: int, rng: np.random.Generator) -> Loop:
    """A loop between two visits of one place."""
    x, y, _, _, _, yaw = rng.normal(size=6) * np.sqrt(np.diag(COVARIANCE))
    return Loop(query, match, transform(x, y, yaw), COVARIANCE, 0.99)


def _megabytes() -> float:
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e3


if __name__ == "__main__":
    tyro.cli(main)
