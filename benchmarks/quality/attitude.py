"""Compare roll, pitch and height of loops with their covariances, for a sensor in a hand and on a car.

    python -m benchmarks.quality.attitude pairs
    python -m benchmarks.quality.attitude search --drives hand:town:08:620 --sensors hdl64e

`pairs` aligns the images of scans that are revisits, with one mounting for the recording and with the gravity of each
scan, without and with registration. `search` searches whole drives, without and with odometry that drifts, and also
counts right loops (within 10 m), wrong ones (beyond 20 m), and the share of revisits (within 5 m) that have a loop.
Both print median errors, the share of errors within 2 standard deviations, and the 95 % quantile of the normalised
error squared of roll, pitch and height, which is 7.81 for a right covariance. Pairs whose position is more than 3 m
or whose yaw is more than 10 degrees off are left out. The constants were fitted on seeds 500 to 507.
"""

import dataclasses
import time
from collections.abc import Iterator, Sequence
from typing import Annotated, NamedTuple

import jax
import numpy as np
import tyro
from jaxtyping import Float
from rich.console import Console
from rich.table import Table

import sglpr_jax
from benchmarks.quality.covariance import ALIAS_DEG, ALIAS_M, STEPS, revisits, twist
from benchmarks.quality.loops import LOOP_M, OTHER_M, REVISIT_M, drifted
from sglpr_jax.data.choices import Gravity
from sglpr_jax.data.gravity import mounted
from sglpr_jax.data.recording import Record, Recording
from sglpr_jax.data.scan_stream import only
from sglpr_jax.loops.acceptance import settled
from sglpr_jax.loops.closure import Loop, planar_loop
from sglpr_jax.loops.config import DetectorConfig
from sglpr_jax.loops.keyframes import square_image
from sglpr_jax.loops.search import FoundLoops, find_loops
from sglpr_jax.registration.bev_alignment import align
from sglpr_jax.registration.gicp import register
from sglpr_jax.se3 import inverse, yaw_of
from sglpr_jax.sim.recording import SimulatedRecording, simulate_recording
from sglpr_jax.sim.scenery import SCENERIES
from sglpr_jax.sim.sensor import SENSORS

UNSEEN = np.array([3, 4, 2])
"""Roll, pitch and height in an error of 6 degrees of freedom."""
OLDER_S = 30.0
GRAVITIES: tuple[Gravity, ...] = ("recording", "auto")
DRIVES = (
    *("hand:town:08:620", "hand:town:00:621", "hand:outskirts:06:622", "hand:gardens:08:623"),
    *("car:town:08:624", "car:outskirts:06:625"),
)
"""CARRIER:SCENERY:ROUTE:SEED. The carrier is hand or car."""
ERRORS = ("roll, pitch [deg]", "height [m]", "roll/pitch/height in 2 sigma", "95 % (7.81)")


@dataclasses.dataclass(frozen=True)
class Pairs:
    """Pairs of scans of one place."""

    drives: tuple[str, ...] = DRIVES
    sensors: tuple[str, ...] = ("hdl64e", "vlp16")
    scans: int = 360
    pairs: int = 40

    def run(self) -> None:
        table = Table("drive", "sensor", "gravity", "6 DoF", "pairs", *ERRORS, "overlap, 5 %", "ms a pair")
        for name, sensor, recording in simulated(self.drives, self.sensors, self.scans):
            chosen = revisits(recording, self.pairs, np.random.default_rng(0))
            frames = np.unique(chosen)
            few, poses = only(in_memory(recording, frames), frames.tolist()), recording.poses.world_from_lidar[frames]
            for gravity in GRAVITIES:
                opened = mounted(dataclasses.replace(few, mounting=None), "auto", gravity=gravity, known=False)
                print(*opened.found, sep="\n")
                loops = list(_near(aligned(opened, np.searchsorted(frames, chosen)), poses))
                start = time.process_time()
                fine = [_registered(opened, loop) for loop in loops]
                ms = 1e3 * (time.process_time() - start) / max(len(loops), 1)
                overlap = f"{np.quantile([loop.overlap or 0.0 for loop in fine], 0.05):.2f}" if fine else "-"
                for how, found, more in (("no", loops, ["", ""]), ("yes", fine, [overlap, f"{ms:.0f}"])):
                    row = [name, sensor, gravity, how, str(len(found)), *errors_of(found, poses), *more]
                    print(*row, flush=True)
                    table.add_row(*row)
        Console(width=170).print(table)


@dataclasses.dataclass(frozen=True)
class Search:
    """Whole drives."""

    drives: tuple[str, ...] = DRIVES
    sensors: tuple[str, ...] = ("hdl64e",)
    scans: int = 360
    weights: str = "sglpr"

    def run(self) -> None:
        params = sglpr_jax.load(self.weights)
        counted = ("gravity", "odometry", "6 DoF", "right", "wrong", "recall")
        table = Table("drive", "sensor", *counted, *ERRORS)
        for name, sensor, recording in simulated(self.drives, self.sensors, self.scans):
            poses = recording.poses.world_from_lidar
            unknown = dataclasses.replace(in_memory(recording), mounting=None)
            odometry = drifted(poses, seed=int(name.split(":")[-1]))
            for gravity, given in [("recording", None), ("auto", None), ("auto", odometry)]:
                opened = mounted(unknown, "auto", gravity=gravity, known=False)
                found = find_loops(opened, params, odometry=given, registered=False)
                print(*found.recording.found, sep="\n")
                for how, loops in (("no", found.loops), ("yes", registered(found))):
                    about = [gravity, "no" if given is None else "yes", how]
                    row = [name, sensor, *about, *counts(loops, recording), *errors_of(loops, poses)]
                    print(*row, flush=True)
                    table.add_row(*row)
        Console(width=170).print(table)


class Drive(NamedTuple):
    """A simulated drive."""

    name: str
    sensor: str
    recording: SimulatedRecording


def simulated(drives: Sequence[str], sensors: Sequence[str], scans: int) -> Iterator[Drive]:
    """The recordings of all drives by all sensors."""
    for name in drives:
        carrier, scenery, route, seed = name.split(":")
        for sensor in sensors:
            lidar = dataclasses.replace(SENSORS[sensor], azimuth_steps=STEPS[sensor])
            options = {"sensor": lidar, "scenery": SCENERIES[scenery], "handheld": carrier == "hand"}
            yield Drive(name, sensor, simulate_recording(route, scans=scans, seed=int(seed), **options))


def in_memory(recording: SimulatedRecording, frames: Sequence[int] | np.ndarray | None = None) -> Recording:
    """The recording, with its scans or those of some frames rendered."""
    chosen = range(len(recording)) if frames is None else frames
    rendered = {recording.paths[i]: recording.points(int(i)) for i in chosen}
    return dataclasses.replace(recording, read=lambda path, labels, lasers: Record(points=rendered[path]))


def aligned(recording: Recording, pairs: np.ndarray) -> Iterator[Loop]:
    """The loops of pairs of query and match, by their images."""
    for query, match in pairs.tolist():
        images = [square_image(recording.record(frame, labels=False)) for frame in (query, match)]
        mountings = {"query_mounting": recording.mounting_of(query), "match_mounting": recording.mounting_of(match)}
        yield planar_loop(query, match, jax.device_get(align(*images)), probability=1.0, **mountings)


def _near(loops: Iterator[Loop], poses: Float[np.ndarray, "n 4 4"]) -> Iterator[Loop]:
    """The loops whose pose is no alias."""
    for loop in loops:
        apart = inverse(inverse(poses[loop.match]) @ poses[loop.query]) @ loop.match_from_query
        if np.linalg.norm(apart[:3, 3]) <= ALIAS_M and abs(yaw_of(apart)) <= np.radians(ALIAS_DEG):
            yield loop


def _registered(recording: Recording, loop: Loop) -> Loop:
    points = [recording.points(frame) for frame in (loop.query, loop.match)]
    found = register(*points, initial=loop.match_from_query, initial_covariance=loop.covariance)
    return dataclasses.replace(loop, **found._asdict())


def registered(found: FoundLoops) -> tuple[Loop, ...]:
    """The loops of a search, registered."""
    kept, _ = settled(found.recording, found.loops, None, DetectorConfig(), registered=True)
    return tuple(kept)


def counts(loops: Sequence[Loop], recording: SimulatedRecording) -> list[str]:
    """Right loops, wrong loops and recall."""
    positions, times = recording.poses.world_from_lidar[:, :3, 3], recording.poses.times
    apart = np.linalg.norm(positions[:, None] - positions[None], axis=2)
    of_loops = np.array([apart[loop.query, loop.match] for loop in loops])
    right = {loop.query for loop in loops if apart[loop.query, loop.match] <= LOOP_M}
    again = (apart <= REVISIT_M) & (times[:, None] - times[None] >= OLDER_S)
    queries = set(np.flatnonzero(again.any(axis=1)).tolist())
    share = len(queries & right) / max(len(queries), 1)
    return [str(int((of_loops <= LOOP_M).sum())), str(int((of_loops > OTHER_M).sum())), f"{share:.3f}"]


def errors_of(loops: Sequence[Loop], poses: Float[np.ndarray, "n 4 4"]) -> list[str]:
    """Errors of roll, pitch and height of the right loops beside their deviations, as cells."""
    right = [one for one in loops if np.linalg.norm(poses[one.query, :3, 3] - poses[one.match, :3, 3]) <= LOOP_M]
    if not right:
        return ["-"] * len(ERRORS)
    apart = [inverse(inverse(poses[one.match]) @ poses[one.query]) @ one.match_from_query for one in right]
    errors = np.array([twist(one) for one in apart])[:, UNSEEN]
    covariances = np.array([one.covariance for one in right])[:, UNSEEN[:, None], UNSEEN]
    sigmas = np.sqrt(np.diagonal(covariances, axis1=1, axis2=2))
    squares = np.einsum("ni,nij,nj->n", errors, np.linalg.inv(covariances), errors)
    degrees, metres = np.degrees(np.abs(errors[:, :2])), np.abs(errors[:, 2])
    within = (np.abs(errors) <= 2 * sigmas).mean(axis=0)
    return [
        f"{np.median(degrees):.2f}, 95 % {np.quantile(degrees, 0.95):.2f}",
        f"{np.median(metres):.3f}, 95 % {np.quantile(metres, 0.95):.3f}",
        "/".join(f"{share:.2f}" for share in within),
        f"{np.quantile(squares, 0.95):.2f}",
    ]


if __name__ == "__main__":
    tyro.cli(Annotated[Pairs, tyro.conf.subcommand("pairs")] | Annotated[Search, tyro.conf.subcommand("search")]).run()
