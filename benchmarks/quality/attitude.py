"""Compare roll, pitch and height of loops with their covariances, for a sensor in a hand and on a car.

    python -m benchmarks.quality.attitude
    python -m benchmarks.quality.attitude --drives car:town:08:620 --sensors hdl64e

Each drive is searched with one mounting for the recording and with the gravity of each scan, without and with odometry
that drifts, each without and with registration. The table shows right loops (within 10 m), wrong ones (beyond 20 m),
the share of revisits (within 5 m) that have a loop, median errors, the share of errors within 2 standard deviations,
and the 95 % quantile of the normalised error squared of roll, pitch and height, which is 7.81 for a right covariance.
The constants were fitted on seeds 500 to 507.
"""

import dataclasses
import time
from collections.abc import Iterator
from typing import Literal, NamedTuple

import numpy as np
import tyro
from jaxtyping import Float
from rich.console import Console
from rich.table import Table

import sglpr_jax
from benchmarks.quality.covariance import STEPS, twist
from benchmarks.quality.loops import LOOP_M, OTHER_M, REVISIT_M, drifted
from sglpr_jax.data.choices import Gravity
from sglpr_jax.data.mounted import mounted
from sglpr_jax.data.record import Record
from sglpr_jax.loops.config import DetectorConfig
from sglpr_jax.loops.find import FoundLoops, find_loops
from sglpr_jax.loops.joint import settled
from sglpr_jax.loops.loop import Loop
from sglpr_jax.loops.transforms import inverse
from sglpr_jax.models.params import Params
from sglpr_jax.sim.recording import SimulatedRecording, simulate_recording
from sglpr_jax.sim.scenery import SCENERIES
from sglpr_jax.sim.sensor import SENSORS

UNSEEN = np.array([3, 4, 2])
"""Roll, pitch and height in an error of 6 degrees of freedom."""
OLDER_S = 30.0


class Drive(NamedTuple):
    """A simulated drive."""

    carrier: Literal["hand", "car"]
    scenery: str
    route: str
    seed: int


class Search(NamedTuple):
    """Loops of one drive, found in one way."""

    gravity: Gravity
    odometry: bool
    registered: bool
    loops: tuple[Loop, ...]
    overlaps: tuple[float, ...]
    """Overlaps of all loops that were registered."""
    ms: float
    """Time of the registration of a loop, in milliseconds."""


def main(
    *,
    drives: tuple[str, ...] = (
        *("hand:town:08:620", "hand:town:00:621", "hand:outskirts:06:622", "hand:gardens:08:623"),
        *("car:town:08:624", "car:outskirts:06:625"),
    ),
    sensors: tuple[str, ...] = ("hdl64e", "vlp16"),
    scans: int = 360,
    weights: str = "sglpr",
) -> None:
    """Print a table: a row for each drive, sensor and way of searching.

    Args:
        drives: CARRIER:SCENERY:ROUTE:SEED. The carrier is hand or car.
        sensors: their names.
        scans: of each drive.
        weights: of the model that describes the scans.
    """
    params = sglpr_jax.load(weights)
    table = Table(
        *("drive", "sensor", "gravity", "odometry", "6 DoF", "right", "wrong", "recall"),
        *("roll, pitch [deg]", "height [m]", "in 2 sigma", "95 % (7.81)", "ms a loop"),
    )
    for name in drives:
        carrier, scenery, route, seed = name.split(":")
        for sensor in sensors:
            recording = in_memory(simulated(Drive(carrier, scenery, route, int(seed)), sensor, scans))
            for search in searches(recording, params, int(seed)):
                row = row_of(recording, search)
                print(name, sensor, *row, flush=True)
                table.add_row(name, sensor, *row)
    Console(width=170).print(table)


def simulated(drive: Drive, sensor: str, scans: int) -> SimulatedRecording:
    """The recording of a drive."""
    lidar = dataclasses.replace(SENSORS[sensor], azimuth_steps=STEPS[sensor])
    options = {"sensor": lidar, "scenery": SCENERIES[drive.scenery], "handheld": drive.carrier == "hand"}
    return simulate_recording(drive.route, scans=scans, seed=drive.seed, **options)


def in_memory(recording: SimulatedRecording) -> SimulatedRecording:
    """The recording, with all scans rendered."""
    rendered = dict(zip(recording.paths, (recording.points(i) for i in range(len(recording))), strict=True))
    return dataclasses.replace(recording, read=lambda path, labels, lasers: Record(points=rendered[path]))


def searches(recording: SimulatedRecording, params: Params, seed: int) -> Iterator[Search]:
    """Search a drive whose mounting is not known, in all ways."""
    unknown, odometry = (
        dataclasses.replace(recording, mounting=None),
        drifted(recording.poses.world_from_lidar, seed=seed),
    )
    gravities: tuple[Gravity, ...] = ("recording", "auto")
    for gravity in gravities:
        opened = mounted(unknown, "auto", gravity=gravity, known=False)
        print(*opened.found, sep="\n")
        for given in (None, odometry):
            found = find_loops(opened, params, odometry=given, registered=False)
            print(*found.recording.found[len(opened.found) :], sep="\n")
            yield Search(gravity, given is not None, False, found.loops, (), 0.0)
            yield registered(found, gravity)


def registered(found: FoundLoops, gravity: Gravity) -> Search:
    """The loops of a search, registered."""
    start = time.process_time()
    kept, rejected = settled(found.recording, found.loops, None, DetectorConfig(), registered=True)
    ms = 1e3 * (time.process_time() - start) / max(len(found.loops), 1)
    overlaps = tuple(loop.overlap or 0.0 for loop in (*kept, *(one.loop for one in rejected)))
    return Search(gravity, found.odometry is not None, True, tuple(kept), overlaps, ms)


def row_of(recording: SimulatedRecording, search: Search) -> list[str]:
    """Cells of a row."""
    poses = recording.poses.world_from_lidar
    apart = np.array([np.linalg.norm(poses[one.query, :3, 3] - poses[one.match, :3, 3]) for one in search.loops])
    right = [loop for loop, metres in zip(search.loops, apart, strict=True) if metres <= LOOP_M]
    errors, covariances = errors_of(right, poses)
    sigmas = np.sqrt(np.diagonal(covariances, axis1=1, axis2=2))
    squares = np.einsum("ni,nij,nj->n", errors, np.linalg.inv(covariances), errors)
    degrees, metres = np.degrees(np.abs(errors[:, :2])), np.abs(errors[:, 2])
    cells = ["-"] * 4
    if len(right):
        within = (np.abs(errors) <= 2 * sigmas).mean(axis=0)
        cells = [
            f"{np.median(degrees):.2f}, 95 % {np.quantile(degrees, 0.95):.2f}",
            f"{np.median(metres):.3f}, 95 % {np.quantile(metres, 0.95):.3f}",
            "/".join(f"{share:.2f}" for share in within),
            f"{np.quantile(squares, 0.95):.2f}",
        ]
    how = [search.gravity, *("yes" if value else "no" for value in (search.odometry, search.registered))]
    counts = [str(len(right)), str(int((apart > OTHER_M).sum())), f"{recall(recording, right):.3f}"]
    return [*how, *counts, *cells, f"{search.ms:.0f}"]


def errors_of(
    loops: list[Loop], poses: Float[np.ndarray, "n 4 4"]
) -> tuple[Float[np.ndarray, "k 3"], Float[np.ndarray, "k 3 3"]]:
    """Errors of roll, pitch (radians) and height (metres) of loops, and their covariances."""
    errors = [twist(inverse(inverse(poses[one.match]) @ poses[one.query]) @ one.match_from_query) for one in loops]
    covariances = np.array([one.covariance for one in loops]).reshape(-1, 6, 6)
    return np.array(errors).reshape(-1, 6)[:, UNSEEN], covariances[:, UNSEEN[:, None], UNSEEN]


def recall(recording: SimulatedRecording, right: list[Loop]) -> float:
    """Share of the scans within 5 m of a scan 30 s older that have a right loop."""
    positions, times = recording.poses.world_from_lidar[:, :3, 3], recording.poses.times
    apart = np.linalg.norm(positions[:, None] - positions[None], axis=2)
    apart[times[:, None] - times[None] < OLDER_S] = np.inf
    revisits = set(np.flatnonzero((apart <= REVISIT_M).any(axis=1)).tolist())
    return len(revisits & {loop.query for loop in right}) / max(len(revisits), 1)


if __name__ == "__main__":
    tyro.cli(main)
