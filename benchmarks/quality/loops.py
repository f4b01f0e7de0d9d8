"""Score loops: on simulated drives with drifting odometry, on ready-made images with and without verification; speed.

    python -m benchmarks.quality.loops simulated --towns 08:101 00:102
    python -m benchmarks.quality.loops images --data BEV_IMAGES --seqs 06
    python -m benchmarks.quality.loops speed

The odometry is that of the true poses, made 1 % too long and turned by half a degree every 100 m, with noise.
"""

import dataclasses
import time
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated

import jax
import numpy as np
import tyro
from jaxtyping import Bool, Float
from rich.console import Console
from rich.progress import track
from rich.table import Table

import sglpr_jax
from sglpr_jax.data.formats.pose_files import read_poses
from sglpr_jax.data.recording import Recording
from sglpr_jax.evaluation.protocols import TopK, protocol_named
from sglpr_jax.loops.acceptance import settled
from sglpr_jax.loops.calibration import Bin, reliability_of
from sglpr_jax.loops.candidates import Compared
from sglpr_jax.loops.closure import Loop, Rejected, planar_loop
from sglpr_jax.loops.comparison import NO_FITS
from sglpr_jax.loops.config import DetectorConfig
from sglpr_jax.loops.detector import LoopDetector
from sglpr_jax.loops.keyframes import Seen
from sglpr_jax.loops.probability import Evidence
from sglpr_jax.models.params import Params
from sglpr_jax.pose_graph.optimize import PoseGraph, trajectory_error
from sglpr_jax.registration.bev_alignment import refined
from sglpr_jax.registration.bev_spectra import query_spectra
from sglpr_jax.same_place import EXCLUDED_FRAMES
from sglpr_jax.se3 import inverse, transform
from sglpr_jax.sim.recording import simulate_recording
from sglpr_jax.sim.sensor import HDL64E

LOOP_M, OTHER_M, REVISIT_M = 10.0, 20.0, 5.0
"""A loop is right up to the first and wrong beyond the second; a revisit that counts is within the third."""
SUCCESS_M, SUCCESS_DEG = 2.0, 5.0
SURE = 0.99
NO_LOOP = -100.0
"""Log odds of pairs that the detector does not consider."""


@dataclasses.dataclass(frozen=True)
class Simulated:
    """Raw scans of towns that no model saw."""

    towns: tuple[str, ...] = ("08:101", "00:102", "06:103")
    """Routes and seeds, ROUTE:SEED."""
    scans: int = 600
    azimuth_steps: int = 900
    weights: str = "sglpr"
    odometry: bool = True
    """Hand in drifting odometry."""
    registered: bool = False
    """Register full scans too (extra slam)."""
    optimized: bool = False
    """Correct the odometry by the loops too (extra gtsam)."""
    seed: int = 0

    def run(self) -> None:
        params = sglpr_jax.load(self.weights)
        sensor = dataclasses.replace(HDL64E, azimuth_steps=self.azimuth_steps)
        sure = {}
        for town in self.towns:
            route, seed = town.split(":")
            drive = simulate_recording(route, scans=self.scans, sensor=sensor, seed=int(seed))
            poses = drive.poses.world_from_lidar
            odometry = drifted(poses, seed=self.seed) if self.odometry else None
            detector, seconds = detect(drive, params, odometry, f"town {town}")
            kept, rejected = settled(drive, detector.loops, odometry, DetectorConfig(), registered=self.registered)
            rejected = [*detector.rejected, *rejected]
            sure[f"town {town}"] = report(f"town {town}", drive, poses, detector, kept, rejected, seconds)
            if self.optimized and odometry is not None:
                found = PoseGraph({0: odometry}, kept).solve()
                before, after = (trajectory_error(each, drive.positions) for each in (odometry, found.poses))
                print(f"  trajectory: off by {before:.2f} m before, {after:.2f} m after, ", end="")
                print(found)
        Console().print(sure_table(sure))


@dataclasses.dataclass(frozen=True)
class Images:
    """Ready-made images: top-1 F1max (3 m / 20 m) before and after verification."""

    data: Path
    """A folder in the layout NN/imgs/*.png with NN/pose.txt."""
    seqs: tuple[str, ...] = ("06",)
    weights: str = "sglpr"
    odometry: bool = False
    """Hand in drifting odometry made from the poses."""
    seed: int = 0

    def run(self) -> None:
        params, sure = sglpr_jax.load(self.weights), {}
        for name in self.seqs:
            recording = sglpr_jax.open_recording(self.data, name)
            poses = np.tile(np.eye(4), (len(recording), 1, 1))
            poses[:, :3] = read_poses(self.data / name / "pose.txt")[[int(frame) for frame in recording.ids]]
            odometry = drifted(poses, seed=self.seed) if self.odometry else None
            detector, seconds = detect(recording, params, odometry, name)
            kept, rejected = settled(recording, detector.loops, odometry, DetectorConfig(), registered=False)
            rejected = [*detector.rejected, *rejected]
            sure[name] = report(name, recording, poses, detector, kept, rejected, seconds)
            log_odds = detector.model.log_odds(Evidence.stack([one.evidence for one in detector.candidates]))
            rest = nearest_of_the_rest(detector)
            log_odds = np.concatenate([log_odds, np.full(len(rest), NO_LOOP)])
            pairs = [(one.query, one.match) for one in detector.candidates] + rest
            agreed = {(loop.query, loop.match) for loop in kept}
            bonus = [1000.0 * (pair in agreed) for pair in pairs]
            for title, scores in (
                ("most probable of three", log_odds),
                ("most probable, loops that were kept first", log_odds + bonus),
            ):
                score_top1(title, recording, pairs, np.asarray(scores))
        Console().print(sure_table(sure))


@dataclasses.dataclass(frozen=True)
class Speed:
    """Processor time of each part, with so many frames behind: of one core under `taskset -c 0`."""

    frames: int = 4541
    repeats: int = 20
    azimuth_steps: int = 900
    weights: str = "sglpr"

    def run(self) -> None:
        detector = LoopDetector(sglpr_jax.load(self.weights))
        finder, sensor = detector.finder, dataclasses.replace(HDL64E, azimuth_steps=self.azimuth_steps)
        drive = simulate_recording("08", scans=60, sensor=sensor, seed=101)
        records = [drive.record(i, labels=False) for i in range(20)]
        rows = np.random.default_rng(0).normal(size=(self.frames, finder.index.width)).astype(np.float32)
        rows /= np.linalg.norm(rows, axis=1, keepdims=True)
        image = finder.seen(records[0]).image
        for frame, row in enumerate(rows):
            finder.add_seen(Seen(row, image, records[0].mounting), time=frame / 10, compared=Compared(NO_FITS, None))
        clock = iter(np.arange(1_000.0, 1_000.0 + 2 * self.repeats))
        rules, nearest = finder.config, np.zeros(finder.config.further, int)
        others = rules.exact_cohort + rules.exact_near_cohort
        cohort = np.zeros(rules.cohort + rules.near_cohort, int)
        spectra, there = query_spectra(image), finder.stored.spectra(np.zeros(1, int))
        peak = finder.comparer.search(spectra, there).one(0)
        for name, work in (
            ("image and descriptor", lambda i: finder.seen(records[i % 20])),
            ("query", lambda i: finder.index.query(rows[i], rules.further)),
            ("rotations", lambda i: jax.block_until_ready(query_spectra(image))),
            ("coarse comparison", lambda i: finder.comparer.coarse(spectra, finder.stored.spectra(nearest))),
            ("comparison", lambda i: finder.comparer.search(spectra, there * rules.candidates)),
            ("refinement", lambda i: jax.block_until_ready(refined(image, image, peak))),
            ("other places, coarse", lambda i: finder.comparer.coarse(spectra, finder.stored.spectra(cohort))),
            ("other places", lambda i: finder.comparer.search(spectra, there * others)),
            ("all of it", lambda i: detector.add(records[i % 20], time=float(next(clock)))),
        ):
            for i in range(self.repeats):  # compiles all programs, some of which only later frames use
                work(i)
            start = time.process_time()
            for i in range(self.repeats):
                work(i)
            print(f"{name}: {1e3 * (time.process_time() - start) / self.repeats:.1f} ms of processor time a scan")


def drifted(poses: Float[np.ndarray, "n 4 4"], *, seed: int, turn_deg: float = 0.5) -> Float[np.ndarray, "n 4 4"]:
    """Odometry of a drive: 1 % too long or short, turned by `turn_deg` every 100 m, both with as much noise again."""
    rng = np.random.default_rng(seed)
    steps = inverse(poses[:-1]) @ poses[1:]
    metres = np.linalg.norm(steps[:, :3, 3], axis=1)
    length = 1 + 0.01 * (rng.choice([-1, 1]) + rng.normal(size=len(steps)))
    turn = np.radians(turn_deg) * (
        rng.choice([-1, 1]) * metres / 100 + rng.normal(size=len(steps)) * np.sqrt(metres / 100)
    )
    found = [np.eye(4)]
    for step, scale, angle in zip(steps, length, turn, strict=True):
        step = step.copy()
        step[:3, 3] *= scale
        found.append(found[-1] @ step @ transform(0.0, 0.0, angle))
    return np.stack(found)


def detect(
    recording: Recording, params: Params, odometry: Float[np.ndarray, "n 4 4"] | None, title: str
) -> tuple[LoopDetector, Float[np.ndarray, " n"]]:
    """The detector after all scans, and how long each took, without reading it."""
    detector, seconds = LoopDetector(params), []
    for i in track(range(len(recording)), description=title):
        record = recording.record(i, labels=False)
        start = time.perf_counter()
        stamp = None if recording.times is None else float(recording.times[i])
        detector.add(record, time=stamp, odometry=None if odometry is None else odometry[i])
        seconds.append(time.perf_counter() - start)
    return detector, np.array(seconds)


def report(
    title: str,
    recording: Recording,
    poses: Float[np.ndarray, "n 4 4"],
    detector: LoopDetector,
    kept: Sequence[Loop],
    rejected: Sequence[Rejected],
    seconds: Float[np.ndarray, " n"],
) -> Bin | None:
    """Print precision, recall, pose errors, calibration and time; return what `calibration` does."""
    print(f"\n{title}: {len(recording)} frames, median {1e3 * np.median(seconds):.1f} ms a frame, ", end="")
    print(f"95 % {1e3 * np.percentile(seconds, 95):.1f} ms, without reading")
    revisited = revisits(recording, poses)
    for name, loops in (("returned by the stream", detector.loops), ("kept of the whole drive", kept)):
        apart = distances(loops, poses)
        found = {loop.query for loop, metres in zip(loops, apart, strict=True) if metres <= LOOP_M}
        recall = np.mean([frame in found for frame in np.flatnonzero(revisited)]) if revisited.any() else np.nan
        print(f"  {name}: {len(loops)} loops, {np.sum(apart > OTHER_M)} wrong (> {OTHER_M:g} m), ", end="")
        print(f"{np.sum((apart > LOOP_M) & (apart <= OTHER_M))} in between; ", end="")
        print(f"recall of {revisited.sum()} revisits < {REVISIT_M:g} m: {recall:.4f}")
    pose_errors("poses of kept loops", kept, poses)
    for reason, count in Counter(one.reason for one in rejected).items():
        right = distances([one.loop for one in rejected if one.reason == reason], poses) <= LOOP_M
        print(f"  {reason}: {count} rejected, of which {right.sum()} right")
    pairs = [planar_loop(c.query, c.match, c.alignment, probability=0.0) for c in detector.candidates]
    for low, high in ((0, REVISIT_M), (REVISIT_M, LOOP_M)):
        near = (distances(pairs, poses) >= low) & (distances(pairs, poses) < high)
        pose_errors(f"poses of all candidates {low:g} to {high:g} m apart", list(np.array(pairs, object)[near]), poses)
    return calibration(detector, poses)


def revisits(recording: Recording, poses: Float[np.ndarray, "n 4 4"]) -> Bool[np.ndarray, " n"]:
    """Which frames come within `REVISIT_M` of a frame that is 30 s (290 frames) older or more."""
    found, positions = np.zeros(len(poses), bool), poses[:, :3, 3]
    for i in range(len(poses)):
        old = np.arange(len(poses)) < i - 290 if recording.times is None else recording.times <= recording.times[i] - 30
        found[i] = bool(old.any()) and np.linalg.norm(positions[old] - positions[i], axis=1).min() < REVISIT_M
    return found


def distances(loops: Sequence[Loop], poses: Float[np.ndarray, "n 4 4"]) -> Float[np.ndarray, " k"]:
    return np.array([np.linalg.norm(poses[loop.query][:3, 3] - poses[loop.match][:3, 3]) for loop in loops])


def pose_errors(title: str, loops: Sequence[Loop], poses: Float[np.ndarray, "n 4 4"]) -> None:
    if not len(loops):
        return print(f"  {title}: none")
    apart = [inverse(inverse(poses[one.match]) @ poses[one.query]) @ one.match_from_query for one in loops]
    metres = np.array([np.linalg.norm(error[:2, 3]) for error in apart])
    degrees = np.abs(np.degrees([np.arctan2(error[1, 0], error[0, 0]) for error in apart]))
    success = np.mean((metres < SUCCESS_M) & (degrees < SUCCESS_DEG))
    print(f"  {title}: {len(loops)}, {success:.4f} within {SUCCESS_M:g} m and {SUCCESS_DEG:g} degrees, ", end="")
    print(f"median {np.median(metres):.3f} m and {np.median(degrees):.3f} degrees")


def calibration(detector: LoopDetector, poses: Float[np.ndarray, "n 4 4"]) -> Bin | None:
    """Print how many of the pairs of each probability are loops; return those at `SURE` and above."""
    bins = reliability_of(detector.candidates, detector.model, poses[:, :3, 3])
    for one in bins:
        share = f"{one.loops} ({one.share:.4f}) are loops, {one.said:.4f} said"
        print(f"  candidates of probability {one.low:g} to {one.high:g}: {one.pairs}, {share}")
    return bins[-1] if bins and bins[-1].low == SURE else None


def sure_table(sure: Mapping[str, Bin | None]) -> Table:
    """At a probability of `SURE` or more, how many are loops: of each drive and of all."""
    table = Table("drive", f"pairs at {SURE:g} or more", "loops", "share", "said")
    there = {title: one for title, one in sure.items() if one is not None}
    rows = [(title, one.pairs, one.loops, one.said) for title, one in there.items()]
    pairs, loops = sum(one.pairs for one in there.values()), sum(one.loops for one in there.values())
    rows.append(("all", pairs, loops, sum(one.pairs * one.said for one in there.values()) / max(pairs, 1)))
    for title, pairs, loops, said in rows:
        table.add_row(title, str(pairs), str(loops), f"{loops / max(pairs, 1):.4f}", f"{said:.4f}")
    return table


def nearest_of_the_rest(detector: LoopDetector) -> list[tuple[int, int]]:
    """Frames without a candidate, and of each the frame of the nearest descriptor that is old enough."""
    finder, known = detector.finder, {one.query for one in detector.candidates}
    frames, descriptors = finder.stored.frames, finder.index.descriptors
    found = []
    for row in np.flatnonzero(~np.isin(frames, list(known))):
        old = frames <= frames[row] - EXCLUDED_FRAMES
        if old.any():
            apart = np.linalg.norm(descriptors[old] - descriptors[row], axis=1)
            found.append((int(frames[row]), int(frames[old][apart.argmin()])))
    return found


def score_top1(
    title: str, recording: Recording, pairs: Sequence[tuple[int, int]], scores: Float[np.ndarray, " n"]
) -> None:
    """Print top-1 F1max and recall@1 where each query is answered by its pair of the highest score."""
    best: dict[int, int] = {}
    for i in np.argsort(scores, kind="stable"):
        best[pairs[i][0]] = int(i)
    queries = np.array(sorted(best))
    chosen = np.array([best[query] for query in queries])
    source = TopK(
        sequence=recording.name,
        positions=recording.positions,
        times=recording.times,
        pose_source=recording.pose_source,
        queries=queries,
        nearest=np.array([pairs[i][1] for i in chosen])[:, None],
        scores=scores[chosen][:, None],
    )
    result = protocol_named("top1-f1max").score(source)
    print(f"  {title}: top-1 F1max {result.score:.4f}, recall@1 (3 m) {result.recalls[1]:.4f}")


if __name__ == "__main__":
    tyro.cli(
        Annotated[Simulated, tyro.conf.subcommand("simulated")]
        | Annotated[Images, tyro.conf.subcommand("images")]
        | Annotated[Speed, tyro.conf.subcommand("speed")]
    ).run()
