"""Loops of simulated drives by several methods, and loops of ready-made images."""

import functools
import json
import os
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import tyro
from jaxtyping import Bool, Float, Float32, Int

import sglpr_jax
from benchmarks import described
from benchmarks.described import DescribedDrive, replay
from benchmarks.drives import EVERYWHERE, Drives, Odometry, odometry_of, on_disk, ready_made
from benchmarks.quality.scoring import (
    STOREY_M,
    Closure,
    Counts,
    closures_of,
    count_loops,
    describe_errors,
    pose_errors,
    represented,
    rule_of,
    town_rule,
)
from benchmarks.table import Table
from benchmarks.timing import run_command
from sglpr_jax.data.choices import Scale
from sglpr_jax.data.formats.pose_files import read_tum
from sglpr_jax.data.mounting import MODEL_HEIGHT_M, Mounting
from sglpr_jax.data.scaled import scaled_poses
from sglpr_jax.data.scan_stream import only
from sglpr_jax.evaluation.protocols.protocol import TopK
from sglpr_jax.evaluation.protocols.top1 import TOP1_F1MAX
from sglpr_jax.loops.acceptance import accept_loops
from sglpr_jax.loops.calibration import reliability_of
from sglpr_jax.loops.config import DetectorConfig
from sglpr_jax.loops.detector import LoopDetector
from sglpr_jax.loops.keyframes import StoredScans
from sglpr_jax.loops.probability import Evidence
from sglpr_jax.loops.result import LoopSearchResult
from sglpr_jax.methods.handcrafted.scan_context import NUMBERS, scan_context, scan_context_distance
from sglpr_jax.pose_graph.files import read_loops_jsonl
from sglpr_jax.pose_graph.optimize import trajectory_error
from sglpr_jax.retrieval.index import Index
from sglpr_jax.same_place import EXCLUDED_FRAMES
from sglpr_jax.sim.recording import SimulatedRecording

PEERS = Path(__file__).resolve().parent / "peers"
WARM_UP = 200
"""Scans of a first search, which does not count."""
KEPT, NO_LOOP = 1000.0, -100.0
"""Log odds that are added to returned loops, so that they have the highest scores, and log odds of missing pairs."""
COLUMNS = ("scans", "loops", "right", "wrong", "recall", "wrong poses", "of these in the plane", "recall by poses")


class Task(NamedTuple):
    """A drive to search."""

    drive: DescribedDrive
    simulate: Callable[[], SimulatedRecording]
    """Returns the recording of the drive."""
    odometry: Float[np.ndarray, "n 4 4"] | None
    params: sglpr_jax.Params
    weights: str
    environment: Path
    keyframe_m: float

    @property
    def detector(self) -> LoopDetector:
        """A detector without scans."""
        return LoopDetector(self.params, config=DetectorConfig(keyframe_m=self.keyframe_m))

    @property
    def folder(self) -> Path:
        """Folder of the scans."""
        return self.drive.path.with_suffix("")

    def files(self) -> Path:
        """Writes the scans in KITTI's format and their times unless they exist, and returns their folder."""
        on_disk(self.simulate(), self.folder)
        np.savetxt(self.folder / "times.txt", self.drive.times)
        return self.folder


class Answer(NamedTuple):
    """Result of a method."""

    closures: list[Closure]
    trajectory: Float[np.ndarray, "n 4 4"] | None = None
    loops: Sequence[Any] = ()
    """Loops of two scans with their poses, if the method has such loops."""


def _search_with(detector: LoopDetector, task: Task) -> Answer:
    """All loops of the detector that are consistent with the odometry."""
    for _ in replay(detector, task.drive, task.odometry):
        pass
    loops, finder = detector.loops, detector.finder
    if task.odometry is not None:
        upright_loops = list(map(finder.to_upright, loops))
        accepted_loops, _ = accept_loops(upright_loops, finder.motion.path, drift=finder.present_drift)
        loops = list(map(finder.to_lidar, accepted_loops))
    return Answer(closures_of(loops), None, loops)


class _ScanContextStore(StoredScans):
    """Stored scans whose nearest scans are found with Scan Context."""

    def nearest(
        self, descriptor: Float32[np.ndarray, " d"], k: int, among: Bool[np.ndarray, " n"]
    ) -> Int[np.ndarray, " j"]:
        """Up to k scans among those with a true `among`, in the order of their distance over all rotations."""
        rows = np.flatnonzero(among)
        distance = scan_context_distance(descriptor[None], self.index.descriptors[rows])[0]
        return rows[np.argsort(distance, kind="stable")[:k]]


def _search_by_scan_context(task: Task) -> Answer:
    """Scan Context chooses the candidates. The loop detector does the rest."""
    detector, recording = task.detector, task.simulate()
    index = Index.empty(NUMBERS, weights_hash=detector.finder.index.weights_hash)
    detector.finder.stored = _ScanContextStore(index)
    keyframes = [
        keyframe._replace(descriptor=scan_context(recording.points(i)))
        for i, keyframe in enumerate(task.drive.keyframes)
    ]
    return _search_with(detector, task._replace(drive=task.drive._replace(keyframes=keyframes)))


def _search_by_bin_loops(task: Task) -> Answer:
    """Runs `bin/loops --odometry auto --optimize` on the scans' files."""
    out = task.folder.with_name(f"{task.folder.name}-ours")
    mounting = task.simulate().mounting or Mounting(MODEL_HEIGHT_M)
    flags = ["--format", "kitti", "--odometry", "auto", "--optimize", "--out", out, "--weights", task.weights]
    flags += ["--sensor-height", str(mounting.height_m)]
    run_command([sys.executable, "-m", "sglpr_jax.cli", "loops", task.files(), *flags])
    loops = read_loops_jsonl(out / "loops.jsonl")
    return Answer(closures_of(loops), read_tum(out / "trajectory-optimized.tum")[0], loops)


def _search_by_local_maps(task: Task, *, method: str) -> Answer:
    """Runs kiss-slam or MapClosures, which close loops between local maps, in its own environment (`peers/run.py`)."""
    out = task.folder.with_name(f"{task.folder.name}-{method}.json")
    run_command([_peer_python(task.environment), PEERS / "run.py", method, task.files(), out])
    answer = json.loads(out.read_text())
    scans_of_maps = [np.arange(first, end) for first, end in answer["maps"]]
    pairs = [sorted((closure["source"], closure["target"]), reverse=True) for closure in answer["closures"]]
    closures = [Closure(scans_of_maps[newer], scans_of_maps[older]) for newer, older in pairs]
    return Answer(closures, np.array(answer["trajectory"]))


METHODS: dict[str, Callable[[Task], Answer]] = {
    "sglpr": lambda task: _search_with(task.detector, task),
    "scan-context": _search_by_scan_context,
    "bin-loops": _search_by_bin_loops,
    "kiss-slam": functools.partial(_search_by_local_maps, method="kiss-slam"),
    "map-closures": functools.partial(_search_by_local_maps, method="map-closures"),
}


READ_FILES = {"bin-loops", "kiss-slam", "map-closures"}
"""Methods that read the files of the scans."""


def _peer_python(environment: Path) -> Path:
    """Python of an environment with kiss-slam and MapClosures, which is created if it does not exist."""
    python = environment / "bin" / "python"
    if not python.exists():
        subprocess.run([sys.executable, "-m", "venv", environment], check=True)
        subprocess.run([python, "-m", "pip", "install", "--quiet", "-r", PEERS / "requirements.txt"], check=True)
    return python.absolute()


def loops(
    drives: tyro.conf.OmitArgPrefixes[Drives] = EVERYWHERE,
    *,
    method: tuple[str, ...] = ("sglpr",),
    odometry: Odometry = "none",
    scale: Scale = 1,
    weights: str = "sglpr",
    keyframe_m: float = DetectorConfig.keyframe_m,
    environment: Path = Path("build/peers"),
    out: Path = Path("build/loops"),
) -> None:
    """Search simulated drives by several methods. Prints a row for each drive and method, and sums.

    A loop in a town is right if its scans are within 10 m, and wrong beyond 20 m. A revisit is a scan within 5 m of a
    scan that is 30 s older. In repeating sceneries, a loop is wrong beyond the scenery's `other_m`, and a revisit is
    within 3 m of a scan that was 30 m of path before. kiss-slam and MapClosures close loops between local maps of
    100 m. Such a loop is right if two of its scans are near each other, and wrong if all are far apart.

    Poses of loops of two scans are right or wrong by `scoring.PoseErrors`. Recall by poses is the share of the scans
    within 3 m of a scan 30 m of path before that have a loop with a right pose.

    Described scans are kept in `out`, so that a further search does not render them. The error of a trajectory is the
    root mean square of positions after rigid alignment. A loop counts for all scans within 3 m of path. kiss-slam,
    map-closures and bin-loops run in separate processes, read files, and their seconds include imports and compilation.

    Args:
        drives: drives to search.
        method: sglpr, scan-context, bin-loops, kiss-slam, map-closures.
        odometry: poses that sglpr and scan-context are given.
        scale: factor for all lengths before a scan is described; another scale needs another folder.
        weights: model that describes the scans.
        keyframe_m: distance between keyframes in metres, of sglpr and scan-context.
        environment: folder of the environment of kiss-slam and MapClosures, made if it does not exist.
        out: folder of the drives.
    """
    params, sums = sglpr_jax.load(weights), dict[tuple[str, str, str], list[np.ndarray]]()
    table = Table("drive", "method", "s", "processor s", *COLUMNS, "error m", "poses of loops")
    for drive in drives:
        simulate = functools.cache(functools.partial(drives.simulate, drive))
        path = out / f"{drive.name}-{drives.scans}x{drives.azimuth_steps}.npz"
        if not path.exists():
            described.store(path, simulate(), params, scale=scale, **drive._asdict())
        stored = described.read(path)
        task = Task(stored, simulate, stored.odometry(odometry, drive.seed), params, weights, environment, keyframe_m)
        poses = scaled_poses(stored.world_from_lidar, 1 / stored.scale)
        rule = rule_of(drive, poses, stored.times)
        if READ_FILES & set(method):
            task.files()  # rendering is not timed
        for name in method:
            start, processor_start = time.perf_counter(), _processor_s()
            answer = METHODS[name](task)
            seconds, processor_seconds = time.perf_counter() - start, _processor_s() - processor_start
            loop_counts = count_loops(answer.closures, poses[:, :3, 3], rule)
            counts = np.array([len(stored.keyframes), *loop_counts, *_pose_counts(stored, answer.loops)])
            error = "-" if answer.trajectory is None else f"{trajectory_error(answer.trajectory, poses[:, :3, 3]):.2f}"
            errors = describe_errors(answer.loops, stored.world_from_lidar)
            times = (f"{seconds:.0f}", f"{processor_seconds:.0f}")
            table.add(drive.name, name, *times, *_cells(counts), error, errors)
            sums.setdefault((drive.world, drive.route, name), []).append(counts)
    table = Table("world", "revisits", "method", *COLUMNS)
    for key, counts in sums.items():
        table.add(*key, *_cells(np.sum(counts, axis=0)))


def _processor_s() -> float:
    """Processor time of this process and its children, in seconds."""
    times = os.times()
    return times.user + times.system + times.children_user + times.children_system


def _cells(counts: Int[np.ndarray, " 10"]) -> list[Any]:
    """Cells of `COLUMNS` from the number of scans, the five `Counts`, and the four numbers of `_pose_counts`."""
    scans, *loop_counts, wrong, in_plane, recalled, revisits = counts.tolist()
    loops = Counts(*loop_counts)
    recall = f"{recalled / revisits:.3f}" if revisits else ""
    return [scans, loops.loops, loops.right, loops.wrong, loops.recall, wrong, in_plane, recall]


def _pose_counts(drive: DescribedDrive, loops: Sequence[Any]) -> list[int]:
    """Numbers of wrong poses, of wrong poses on the same storey, of revisits with a right pose, and of revisits."""
    poses = np.array([loop.match_from_query for loop in loops])
    errors = pose_errors([(loop.query, loop.match) for loop in loops], poses, drive.world_from_lidar)
    right_queries = {loop.query for loop, is_right in zip(loops, errors.right, strict=True) if is_right}
    right_queries = represented(right_queries, scaled_poses(drive.world_from_lidar, 1 / drive.scale)[:, :3, 3])
    revisits = set(np.flatnonzero(drive.revisits).tolist())
    wrong_on_storey = errors.wrong & (errors.storey_m <= STOREY_M)
    return [int(errors.wrong.sum()), int(wrong_on_storey.sum()), len(right_queries & revisits), len(revisits)]


def images(
    *,
    data: Path,
    seqs: tuple[str, ...] = ("06",),
    weights: str = "sglpr",
    odometry: bool = False,
    seed: int = 0,
    keyframe_m: float = DetectorConfig.keyframe_m,
) -> None:
    """Search ready-made images. Prints loops, time, calibration, and top-1 F1max (3 m / 20 m) after verification.

    The processor milliseconds are those of the search of a whole drive, divided by its scans: under `taskset -c 0`.

    F1max needs a match of every scan, so it is printed if all are keyframes (`--keyframe-m 0`).

    Args:
        data: folder in the layout NN/imgs/*.png with NN/pose.txt.
        seqs: sequences.
        weights: model that describes the images.
        odometry: use drifting odometry made from the poses.
        seed: seed of the drift.
        keyframe_m: distance between keyframes in metres.
    """
    params, config = sglpr_jax.load(weights), DetectorConfig(keyframe_m=keyframe_m)
    for name in seqs:
        recording, poses = ready_made(data, name)
        given = odometry_of("drifting" if odometry else "none", poses, seed=seed)
        options = {"registered": False, "config": config}
        sglpr_jax.find_loops(only(recording, range(WARM_UP)), params, **options)  # compiles
        start = time.process_time()
        found = sglpr_jax.find_loops(recording, params, odometry=given, **options)
        milliseconds = 1e3 * (time.process_time() - start) / len(recording)
        counts = count_loops(closures_of(found.loops), poses[:, :3, 3], town_rule(poses[:, :3, 3], recording.times))
        errors = describe_errors(found.loops, poses)
        print(f"{name}: {counts.loops} loops, {counts.wrong} wrong, recall {counts.recall}; {errors}")
        print(f"  {milliseconds:.1f} ms a scan, {found.sessions[0].keyframes} keyframes of {len(recording)} scans")
        assert found.model is not None
        for one in reliability_of(found.sessions[0].candidates, found.model, poses[:, :3, 3]):
            share = f"{one.pairs} pairs, {one.share:.4f} are loops, {one.probability:.4f} said"
            print(f"  probability {one.low:g} to {one.high:g}: {share}")
        if not keyframe_m:
            _report_top1(found, poses, sglpr_jax.embed(params, recording).descriptors)


def _report_top1(
    found: LoopSearchResult, poses: Float[np.ndarray, "n 4 4"], descriptors: Float32[np.ndarray, "n d"]
) -> None:
    """Prints top-1 F1max and Recall@1 of the most probable match of each query, without and with loops preferred.

    The match of a frame without a candidate is the nearest descriptor that is old enough, with the log odds NO_LOOP.
    """
    assert found.model is not None
    session = found.sessions[0]
    pairs = [(pair.query, pair.match) for pair in session.candidates]
    log_odds = found.model.log_odds(Evidence.stack([pair.evidence for pair in session.candidates]))
    for frame in sorted({*range(EXCLUDED_FRAMES, len(poses))} - {query for query, _ in pairs}):
        distance = np.linalg.norm(descriptors[: frame - EXCLUDED_FRAMES + 1] - descriptors[frame], axis=1)
        pairs.append((frame, int(distance.argmin())))
    log_odds = np.pad(log_odds, (0, len(pairs) - len(log_odds)), constant_values=NO_LOOP)
    loops = {(loop.query, loop.match) for loop in found.loops}
    bonus = np.array([KEPT * (pair in loops) for pair in pairs])
    for title, scores in (("most probable", log_odds), ("most probable, loops first", log_odds + bonus)):
        # In ascending order of scores, so that the best pair of each query remains.
        best_pair = {pairs[i][0]: i for i in np.argsort(scores, kind="stable").tolist()}
        queries = sorted(best_pair)
        chosen = np.array([best_pair[query] for query in queries])
        source = TopK(
            sequence=session.recording.name,
            positions=poses[:, :3, 3],
            times=session.recording.times,
            pose_source=session.recording.pose_source,
            queries=np.array(queries),
            nearest=np.array([pairs[i][1] for i in chosen])[:, None],
            scores=scores[chosen][:, None],
        )
        result = TOP1_F1MAX(source)
        print(f"  {title}: top-1 F1max {result.score:.4f}, recall@1 (3 m) {result.recalls[1]:.4f}")
