"""Wrong loops and recall where places repeat: ours, Scan Context with the same verification, and MapClosures.

    python -m benchmarks.quality.repeating_peers --environment build/peers
    python -m benchmarks.quality.repeating_peers --drives tunnel:none:21 car_park:same:21

A loop is wrong if its scans are farther apart than the scenery's `other_m`; revisits are those of `repeating.py`.
Scan Context chooses the candidates and nothing else: motion, comparison of the images and sequential test are ours.
MapClosures runs in an environment of its own, which is made on first use, on the odometry of kiss-icp; a closure
between two local maps is wrong if all of their scans are that far apart, and finds the scans of the newer map that are
near one of the older map.
"""

import dataclasses
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import tyro
from jaxtyping import Bool, Float, Float32, Int
from rich.console import Console
from rich.table import Table

import sglpr_jax
from benchmarks.quality.drives import distances
from benchmarks.quality.map_closures import peer_python, run_peer
from benchmarks.quality.repeating import REVISIT_M, WAY_M, revisits
from sglpr_jax.data.recording import Record
from sglpr_jax.loops.candidates import CandidateFinder
from sglpr_jax.loops.detector import LoopDetector
from sglpr_jax.loops.keyframes import Seen, StoredScans
from sglpr_jax.methods.handcrafted.scan_context import NUMBERS, scan_context, scan_context_distance
from sglpr_jax.models.params import Params
from sglpr_jax.retrieval.index import Index
from sglpr_jax.se3 import distances as all_distances
from sglpr_jax.sim.recording import SimulatedRecording
from sglpr_jax.sim.repeating import simulate_repeating
from sglpr_jax.sim.sceneries import REPEATING
from sglpr_jax.sim.sensor import HDL64E

DRIVES = tuple(
    f"{name}:{revisit}:21"
    for name in ("car_park", "garage", "corridor", "rooms", "tunnel", "highway", "row_houses", "orchard")
    for revisit in ("none", "same")
)


class ByScanContext(StoredScans):
    """Stored scans whose nearest ones are those by Scan Context."""

    def nearest(
        self, descriptor: Float32[np.ndarray, " d"], k: int, among: Bool[np.ndarray, " n"]
    ) -> Int[np.ndarray, " j"]:
        """Up to k scans that are nearest over all rotations, in order."""
        allowed = np.flatnonzero(among)
        apart = scan_context_distance(descriptor[None], self.index.descriptors[allowed])[0]
        return allowed[np.argsort(apart, kind="stable")[:k]]


class ScanContextFinder(CandidateFinder):
    """Candidates by Scan Context: its distance over all rotations."""

    def __init__(self, params: Params):
        super().__init__(params)
        self.stored = ByScanContext(Index.empty(NUMBERS, weights_hash=self.index.weights_hash))

    def seen(self, record: Record) -> Seen:
        """The matrix of Scan Context in place of the descriptor."""
        return super().seen(record)._replace(descriptor=scan_context(np.asarray(record.points)[:, :3]))


@dataclasses.dataclass(frozen=True)
class Counts:
    """What one method found on one drive."""

    loops: int
    wrong: int
    found: int
    revisits: int
    seconds: float


def main(
    *,
    drives: Sequence[str] = DRIVES,
    scans: int = 700,
    azimuth_steps: int = 900,
    weights: str = "sglpr",
    environment: Path = Path("build/peers"),
) -> None:
    """Print a table of all drives.

    Args:
        drives: SCENERY:REVISIT:SEED each.
        scans: of each drive, 10 a second, which kiss-icp needs.
        azimuth_steps: firings of the sensor per turn.
        weights: of our descriptors.
        environment: the folder of MapClosures' own environment.
    """
    python, params = peer_python(environment), sglpr_jax.load(weights)
    sensor = dataclasses.replace(HDL64E, azimuth_steps=azimuth_steps)
    columns = ("drive", "method", "loops", "wrong", "recall", "ms a scan")
    table = Table(*columns, title=f"{scans} scans each; recall of revisits within {REVISIT_M:g} m")
    for drive in drives:
        scenery, revisit, seed = drive.split(":")
        recording: Any = simulate_repeating(
            scenery, scans=scans, seed=int(seed), sensor=sensor, revisit=revisit, rate_hz=10.0
        )
        other_m = REPEATING[scenery].other_m
        context = LoopDetector(params)
        context.finder = ScanContextFinder(params)
        rows = {
            "ours": detected(LoopDetector(params), recording, other_m),
            "Scan Context, same verification": detected(context, recording, other_m),
            "MapClosures": closed(run_peer(python, recording), recording, other_m),
        }
        for method, one in rows.items():
            recall = f"{one.found / one.revisits:.3f}" if one.revisits else ""
            cells = (str(one.loops), str(one.wrong), recall, f"{1e3 * one.seconds:.0f}")
            table.add_row(drive, method, *cells)
            print(drive, method, *cells, flush=True)
    Console().print(table)


def detected(detector: LoopDetector, recording: SimulatedRecording, other_m: float) -> Counts:
    """The loops of a detector over a drive."""
    seconds = 0.0
    for i in range(len(recording)):
        record = recording.record(i, labels=False)
        start = time.perf_counter()
        detector.add(record, time=float(recording.poses.times[i]))
        seconds += time.perf_counter() - start
    poses = recording.poses.world_from_lidar
    apart = distances([(loop.query, loop.match) for loop in detector.loops], poses)
    found = {loop.query for loop, metres in zip(detector.loops, apart, strict=True) if metres <= other_m}
    return _counts(len(detector.loops), int((apart > other_m).sum()), found, recording, other_m, seconds)


def closed(peer: dict[str, Any], recording: SimulatedRecording, other_m: float) -> Counts:
    """The closures of MapClosures."""
    positions = recording.poses.world_from_lidar[:, :3, 3]
    maps, wrong, found = [np.arange(*ends) for ends in peer["maps"]], 0, set[int]()
    for closure in peer["closures"]:
        older, newer = sorted((maps[closure["source"]], maps[closure["target"]]), key=lambda scans: scans[0])
        apart = all_distances(positions[newer], positions[older]).min(axis=1)
        wrong += int(apart.min() > other_m)
        found |= set(newer[apart <= other_m].tolist())
    return _counts(len(peer["closures"]), wrong, found, recording, other_m, peer["seconds"]["maps and closures"])


def _counts(
    loops: int, wrong: int, found: set[int], recording: SimulatedRecording, other_m: float, seconds: float
) -> Counts:
    positions: Float[np.ndarray, "n 3"] = recording.poses.world_from_lidar[:, :3, 3]
    revisited = np.flatnonzero(revisits(positions, min(REVISIT_M, other_m / 2), WAY_M))
    right = sum(frame in found for frame in revisited.tolist())
    return Counts(loops, wrong, right, len(revisited), seconds / len(recording))


if __name__ == "__main__":
    tyro.cli(main)
