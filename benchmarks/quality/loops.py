"""Loops of simulated drives by several methods, and loops of ready-made images."""

import functools
import json
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Float32, Int
from rich.console import Console
from rich.table import Table

import sglpr_jax
from benchmarks.drives import Case, odometry_of, on_disk
from benchmarks.quality.scoring import Closure, closures_of, counted, repeating_rule, told, town_rule
from benchmarks.timing import run_command
from sglpr_jax.data.formats.pose_files import read_poses, read_tum
from sglpr_jax.data.mounting import MODEL_HEIGHT_M, Mounting
from sglpr_jax.data.scan import Scan
from sglpr_jax.evaluation.protocols.protocol import TopK
from sglpr_jax.evaluation.protocols.top1 import TOP1_F1MAX
from sglpr_jax.loops.calibration import reliability_of
from sglpr_jax.loops.candidates import CandidateSearch
from sglpr_jax.loops.detector import LoopDetector
from sglpr_jax.loops.keyframes import Keyframe, StoredScans
from sglpr_jax.loops.probability import Evidence
from sglpr_jax.loops.result import LoopSearchResult
from sglpr_jax.methods.handcrafted.scan_context import NUMBERS, scan_context, scan_context_distance
from sglpr_jax.models.params import Params
from sglpr_jax.pose_graph.files import read_loops_jsonl
from sglpr_jax.pose_graph.optimize import trajectory_error
from sglpr_jax.retrieval.index import Index
from sglpr_jax.same_place import EXCLUDED_FRAMES
from sglpr_jax.sim.recording import SimulatedRecording
from sglpr_jax.sim.styles import SCENERIES

PEERS = Path(__file__).resolve().parent / "peers"
KEPT, NO_LOOP = 1000.0, -100.0
"""Log odds that a returned loop gets in addition, so that it is answered first, and those of pairs that are none."""


class Drive(NamedTuple):
    """A simulated drive, and the folder of its files."""

    case: Case
    recording: SimulatedRecording
    folder: Path

    def files(self) -> Path:
        """The folder of the scans in KITTI's format, with their times."""
        on_disk(self.recording, self.folder)
        np.savetxt(self.folder / "times.txt", self.recording.poses.times)
        return self.folder


class Found(NamedTuple):
    """What a method found, and what it took."""

    closures: list[Closure]
    trajectory: Float[np.ndarray, "n 4 4"] | None
    seconds: float
    processor_seconds: float
    loops: Sequence[Any] = ()
    """Loops of two scans with their poses, if the method has such loops."""


def _ours(drive: Drive, *, weights: str, **_: Any) -> Found:
    """`find_loops` without odometry."""
    params, start = sglpr_jax.load(weights), (time.perf_counter(), time.process_time())
    loops = sglpr_jax.find_loops(drive.recording, params, registered=False).loops
    taken = time.perf_counter() - start[0], time.process_time() - start[1]
    return Found(closures_of(loops), None, *taken, loops)


class _ByScanContext(StoredScans):
    """Stored scans whose nearest ones are those by Scan Context."""

    def nearest(
        self, descriptor: Float32[np.ndarray, " d"], k: int, among: Bool[np.ndarray, " n"]
    ) -> Int[np.ndarray, " j"]:
        """Up to k scans that are nearest over all rotations, in order."""
        allowed = np.flatnonzero(among)
        apart = scan_context_distance(descriptor[None], self.index.descriptors[allowed])[0]
        return allowed[np.argsort(apart, kind="stable")[:k]]


class _ScanContextFinder(CandidateSearch):
    """Candidates by Scan Context: its distance over all rotations."""

    def __init__(self, params: Params):
        super().__init__(params)
        self.stored = _ByScanContext(Index.empty(NUMBERS, weights_hash=self.index.weights_hash))

    def keyframe(self, scan: Scan) -> Keyframe:
        """The matrix of Scan Context in place of the descriptor."""
        return super().keyframe(scan)._replace(descriptor=scan_context(np.asarray(scan.points)[:, :3]))


def _scan_context(drive: Drive, *, weights: str, **_: Any) -> Found:
    """Scan Context chooses the candidates and nothing else: motion, comparison of images and decision are ours."""
    detector = LoopDetector(sglpr_jax.load(weights))
    detector.finder = _ScanContextFinder(detector.finder.params)
    start = time.perf_counter(), time.process_time()
    for i, stamp in enumerate(drive.recording.poses.times.tolist()):
        detector.add(drive.recording.scan(i, labels=False), time=stamp)
    taken = time.perf_counter() - start[0], time.process_time() - start[1]
    return Found(closures_of(detector.loops), None, *taken, detector.loops)


def _bin_loops(drive: Drive, *, weights: str, **_: Any) -> Found:
    """`bin/loops --odometry auto --optimize`, with imports, compilation and the pages that it writes."""
    out = drive.folder.with_name(f"{drive.folder.name}-ours")
    mounting = drive.recording.mounting or Mounting(MODEL_HEIGHT_M)
    flags = ["--format", "kitti", "--odometry", "auto", "--optimize", "--out", out, "--weights", weights]
    flags += ["--sensor-height", str(mounting.height_m)]
    taken = run_command([sys.executable, "-m", "sglpr_jax.cli", "loops", drive.files(), *flags])
    loops = read_loops_jsonl(out / "loops.jsonl")
    return Found(closures_of(loops), read_tum(out / "trajectory-optimized.tum")[0], *taken, loops)


def _local_maps(drive: Drive, *, method: str, environment: Path, **_: Any) -> Found:
    """A program that closes loops between local maps. MapClosures does not correct kiss-icp's odometry."""
    out = drive.folder.with_name(f"{drive.folder.name}-{method}.json")
    taken = run_command([_peer_python(environment), PEERS / "run.py", method, drive.files(), out])
    said = json.loads(out.read_text())
    maps = [np.arange(*ends) for ends in said["maps"]]
    closed = [sorted((one["source"], one["target"]), reverse=True) for one in said["closures"]]
    return Found([Closure(maps[newer], maps[older]) for newer, older in closed], np.array(said["trajectory"]), *taken)


METHODS: dict[str, Callable[..., Found]] = {
    "sglpr": _ours,
    "scan-context": _scan_context,
    "bin-loops": _bin_loops,
    "kiss-slam": functools.partial(_local_maps, method="kiss-slam"),
    "map-closures": functools.partial(_local_maps, method="map-closures"),
}


def _peer_python(environment: Path) -> Path:
    """The Python of kiss-slam's and MapClosures' environment. It has another numpy, and is made on first use."""
    python = environment / "bin" / "python"
    if not python.exists():
        subprocess.run([sys.executable, "-m", "venv", environment], check=True)
        subprocess.run([python, "-m", "pip", "install", "--quiet", "-r", PEERS / "requirements.txt"], check=True)
    return python.absolute()


def simulated(
    *,
    drives: tuple[str, ...] = ("town:08:101", "town:00:102", "town:06:103"),
    sensors: tuple[str, ...] = ("hdl64e",),
    methods: tuple[str, ...] = ("sglpr",),
    scans: int = 1000,
    azimuth_steps: int = 900,
    weights: str = "sglpr",
    environment: Path = Path("build/peers"),
    out: Path = Path("build/loops"),
) -> None:
    """Search simulated drives, 10 scans a second, by several methods. Prints a row for each drive and method.

    A loop in a town is right if its scans are within 10 m and wrong beyond 20 m; recall is that of scans within 5 m of
    one that is 30 s older. Where places repeat, a loop is wrong beyond the scenery's `other_m`; recall is that of scans
    within 3 m of one that was 30 m of path before. kiss-slam and MapClosures close loops between local maps of 100 m:
    such a loop is right if two of its scans are near each other, and wrong if all are far apart. The error of a
    trajectory is the root mean square of positions after rigid alignment. Methods in processes of their own
    (kiss-slam, map-closures, bin-loops) read files; their seconds contain imports and compilation.

    Args:
        drives: WORLD:ROUTE:SEED[:SENSOR]. In a town, route 00 revisits places in the same direction, 08 in the opposite
            one. In a scenery that repeats, the route is none, same or opposite.
        sensors: sensors of drives without one, with +CARRIER.
        methods: sglpr, scan-context, bin-loops, kiss-slam, map-closures.
        scans: scans of each drive.
        azimuth_steps: firings of the sensor per turn.
        weights: model that describes the scans.
        environment: folder of the environment of kiss-slam and MapClosures, made if it does not exist.
        out: folder of the files for other processes.
    """
    columns = ("drive", "method", "s", "processor s", "loops", "right", "wrong", "recall", "error m")
    table = Table(*columns)
    for text in drives:
        for sensor in sensors if text.count(":") == 2 else (text.split(":")[-1],):
            case = Case.of(text, sensor=sensor)
            recording = case.simulate(scans=scans, azimuth_steps=azimuth_steps, rate_hz=10.0)
            poses, positions = recording.poses.world_from_lidar, recording.poses.world_from_lidar[:, :3, 3]
            in_town = case.world in SCENERIES
            rule = town_rule(positions, recording.times) if in_town else repeating_rule(poses, case.other_m)
            drive = Drive(case, recording, out / f"{'-'.join(map(str, case))}-{scans}x{azimuth_steps}")
            for method in methods:
                found = METHODS[method](drive, weights=weights, environment=environment)
                counts = counted(found.closures, positions, rule)
                error = "-" if found.trajectory is None else f"{trajectory_error(found.trajectory, positions):.2f}"
                cells = (f"{found.seconds:.0f}", f"{found.processor_seconds:.0f}", *map(str, counts[:3]))
                table.add_row(f"{text}, {sensor}", method, *cells, counts.recall, error)
                print(text, sensor, method, *cells, counts.recall, error, told(found.loops, poses), flush=True)
    Console(width=140).print(table)


def images(
    *, data: Path, seqs: tuple[str, ...] = ("06",), weights: str = "sglpr", odometry: bool = False, seed: int = 0
) -> None:
    """Search ready-made images. Prints loops, calibration, and top-1 F1max (3 m / 20 m) after verification.

    Args:
        data: folder in the layout NN/imgs/*.png with NN/pose.txt.
        seqs: sequences.
        weights: model that describes the images.
        odometry: use drifting odometry made from the poses.
        seed: seed of the drift.
    """
    params = sglpr_jax.load(weights)
    for name in seqs:
        recording = sglpr_jax.open_recording(data, name)
        poses = np.tile(np.eye(4), (len(recording), 1, 1))
        poses[:, :3] = read_poses(data / name / "pose.txt")[[int(frame) for frame in recording.ids]]
        given = odometry_of("drifting" if odometry else "none", poses, seed=seed)
        found = sglpr_jax.find_loops(recording, params, odometry=given, registered=False)
        counts = counted(closures_of(found.loops), poses[:, :3, 3], town_rule(poses[:, :3, 3], recording.times))
        print(f"{name}: {counts.loops} loops, {counts.wrong} wrong, recall {counts.recall}; {told(found.loops, poses)}")
        assert found.model is not None
        for one in reliability_of(found.sessions[0].candidates, found.model, poses[:, :3, 3]):
            share = f"{one.pairs} pairs, {one.share:.4f} are loops, {one.probability:.4f} said"
            print(f"  probability {one.low:g} to {one.high:g}: {share}")
        _report_top1(found, poses, sglpr_jax.embed(params, recording).descriptors)


def _report_top1(
    found: LoopSearchResult, poses: Float[np.ndarray, "n 4 4"], descriptors: Float32[np.ndarray, "n d"]
) -> None:
    """Print top-1 F1max and Recall@1 if each query is answered by its most probable pair, or by a returned loop.

    Frames without a candidate are answered by the nearest descriptor that is old enough, with the least log odds.
    """
    assert found.model is not None
    pairs = [(one.query, one.match) for one in found.sessions[0].candidates]
    log_odds = found.model.log_odds(Evidence.stack([one.evidence for one in found.sessions[0].candidates]))
    for frame in sorted({*range(EXCLUDED_FRAMES, len(poses))} - {query for query, _ in pairs}):
        apart = np.linalg.norm(descriptors[: frame - EXCLUDED_FRAMES + 1] - descriptors[frame], axis=1)
        pairs.append((frame, int(apart.argmin())))
    log_odds = np.pad(log_odds, (0, len(pairs) - len(log_odds)), constant_values=NO_LOOP)
    kept = {(one.query, one.match) for one in found.loops}
    bonus = np.array([KEPT * (pair in kept) for pair in pairs])
    for title, scores in (("most probable", log_odds), ("most probable, loops first", log_odds + bonus)):
        best: dict[int, int] = {}
        for i in np.argsort(scores, kind="stable").tolist():
            best[pairs[i][0]] = i
        queries = np.array(sorted(best))
        chosen = np.array([best[query] for query in queries.tolist()])
        source = TopK(
            sequence=found.sessions[0].recording.name,
            positions=poses[:, :3, 3],
            times=found.sessions[0].recording.times,
            pose_source=found.sessions[0].recording.pose_source,
            queries=queries,
            nearest=np.array([pairs[i][1] for i in chosen])[:, None],
            scores=scores[chosen][:, None],
        )
        result = TOP1_F1MAX(source)
        print(f"  {title}: top-1 F1max {result.score:.4f}, recall@1 (3 m) {result.recalls[1]:.4f}")
