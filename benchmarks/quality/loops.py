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
from benchmarks.drives import EVERYWHERE, Drives, Odometry, odometry_of, on_disk
from benchmarks.quality.scoring import (
    STOREY_M,
    Closure,
    Counts,
    closures_of,
    counted,
    pose_errors,
    rule_of,
    told,
    town_rule,
)
from benchmarks.table import Table
from benchmarks.timing import run_command
from sglpr_jax.data.choices import Scale
from sglpr_jax.data.formats.pose_files import read_poses, read_tum
from sglpr_jax.data.mounting import MODEL_HEIGHT_M, Mounting
from sglpr_jax.data.scaled import scaled_poses
from sglpr_jax.evaluation.protocols.protocol import TopK
from sglpr_jax.evaluation.protocols.top1 import TOP1_F1MAX
from sglpr_jax.loops.acceptance import accept_loops
from sglpr_jax.loops.calibration import reliability_of
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
KEPT, NO_LOOP = 1000.0, -100.0
"""Log odds that a returned loop gets in addition, so that it is answered first, and those of pairs that are none."""
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

    @property
    def folder(self) -> Path:
        """Folder of the scans."""
        return self.drive.path.with_suffix("")

    def files(self) -> Path:
        """The folder, with the scans in KITTI's format and their times."""
        on_disk(self.simulate(), self.folder)
        np.savetxt(self.folder / "times.txt", self.drive.times)
        return self.folder


class Answer(NamedTuple):
    """What a method returns."""

    closures: list[Closure]
    trajectory: Float[np.ndarray, "n 4 4"] | None = None
    loops: Sequence[Any] = ()
    """Loops of two scans with their poses, if the method has such loops."""


def _by_detector(task: Task, detector: LoopDetector) -> Answer:
    """All loops of the detector that the odometry does not contradict."""
    for _ in replay(detector, task.drive, task.odometry):
        pass
    loops, drift = detector.loops, detector.finder.present_drift
    loops = loops if task.odometry is None else accept_loops(loops, detector.finder.motion.path, drift=drift)[0]
    return Answer(closures_of(loops), None, loops)


class _StoredByScanContext(StoredScans):
    """Stored scans whose nearest ones are those by Scan Context."""

    def nearest(
        self, descriptor: Float32[np.ndarray, " d"], k: int, among: Bool[np.ndarray, " n"]
    ) -> Int[np.ndarray, " j"]:
        """Up to k scans that are nearest over all rotations, in order."""
        allowed = np.flatnonzero(among)
        apart = scan_context_distance(descriptor[None], self.index.descriptors[allowed])[0]
        return allowed[np.argsort(apart, kind="stable")[:k]]


def _by_scan_context(task: Task) -> Answer:
    """Scan Context chooses the candidates and nothing else: motion, comparison of images and decision are ours."""
    detector, recording = LoopDetector(task.params), task.simulate()
    index = Index.empty(NUMBERS, weights_hash=detector.finder.index.weights_hash)
    detector.finder.stored = _StoredByScanContext(index)
    keyframes = [
        keyframe._replace(descriptor=scan_context(recording.points(i)))
        for i, keyframe in enumerate(task.drive.keyframes)
    ]
    return _by_detector(task._replace(drive=task.drive._replace(keyframes=keyframes)), detector)


def _by_bin_loops(task: Task) -> Answer:
    """`bin/loops --odometry auto --optimize`, with imports, compilation and the pages that it writes."""
    out = task.folder.with_name(f"{task.folder.name}-ours")
    mounting = task.simulate().mounting or Mounting(MODEL_HEIGHT_M)
    flags = ["--format", "kitti", "--odometry", "auto", "--optimize", "--out", out, "--weights", task.weights]
    flags += ["--sensor-height", str(mounting.height_m)]
    run_command([sys.executable, "-m", "sglpr_jax.cli", "loops", task.files(), *flags])
    loops = read_loops_jsonl(out / "loops.jsonl")
    return Answer(closures_of(loops), read_tum(out / "trajectory-optimized.tum")[0], loops)


def _by_local_maps(task: Task, *, method: str) -> Answer:
    """A program that closes loops between local maps. MapClosures does not correct kiss-icp's odometry."""
    out = task.folder.with_name(f"{task.folder.name}-{method}.json")
    run_command([_peer_python(task.environment), PEERS / "run.py", method, task.files(), out])
    answer = json.loads(out.read_text())
    maps = [np.arange(*ends) for ends in answer["maps"]]
    pairs = [sorted((one["source"], one["target"]), reverse=True) for one in answer["closures"]]
    return Answer([Closure(maps[newer], maps[older]) for newer, older in pairs], np.array(answer["trajectory"]))


METHODS: dict[str, Callable[[Task], Answer]] = {
    "sglpr": lambda task: _by_detector(task, LoopDetector(task.params)),
    "scan-context": _by_scan_context,
    "bin-loops": _by_bin_loops,
    "kiss-slam": functools.partial(_by_local_maps, method="kiss-slam"),
    "map-closures": functools.partial(_by_local_maps, method="map-closures"),
}


def _peer_python(environment: Path) -> Path:
    """The Python of kiss-slam's and MapClosures' environment. It has another numpy, and is made on first use."""
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
    environment: Path = Path("build/peers"),
    out: Path = Path("build/loops"),
) -> None:
    """Search simulated drives by several methods. Prints a row for each drive and method, and sums.

    A loop in a town is right if its scans are within 10 m and wrong beyond 20 m; recall is that of scans within 5 m of
    one that is 30 s older. Where places repeat, a loop is wrong beyond the scenery's `other_m`; recall is that of scans
    within 3 m of one that was 30 m of path before. kiss-slam and MapClosures close loops between local maps of 100 m:
    such a loop is right if two of its scans are near each other, and wrong if all are far apart.

    Poses of loops of two scans are wrong by `scoring.PoseErrors`. Recall by poses is that of scans within 3 m of one
    that was 30 m of path before, on the same storey.

    Described scans are kept in `out`, so that a further search does not render them. The error of a trajectory is the
    root mean square of positions after rigid alignment. Methods in processes of their own (kiss-slam, map-closures,
    bin-loops) read files; their seconds contain imports and compilation.

    Args:
        drives: drives to search.
        method: sglpr, scan-context, bin-loops, kiss-slam, map-closures.
        odometry: poses that sglpr and scan-context are given.
        scale: factor for all lengths before a scan is described; another scale needs another folder.
        weights: model that describes the scans.
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
        given = stored.odometry(odometry, drive.seed)
        poses = scaled_poses(stored.world_from_lidar, 1 / stored.scale)
        rule = rule_of(drive, poses, stored.times)
        for name in method:
            start = time.perf_counter(), _processor_s()
            answer = METHODS[name](Task(stored, simulate, given, params, weights, environment))
            seconds = time.perf_counter() - start[0], _processor_s() - start[1]
            counts = counted(answer.closures, poses[:, :3, 3], rule)
            numbers = np.array([len(stored.keyframes), *counts, *_pose_counts(stored, answer.loops)])
            error = "-" if answer.trajectory is None else f"{trajectory_error(answer.trajectory, poses[:, :3, 3]):.2f}"
            errors = told(answer.loops, stored.world_from_lidar)
            table.add(drive.name, name, *(f"{value:.0f}" for value in seconds), *_cells(numbers), error, errors)
            sums.setdefault((drive.world, drive.route, name), []).append(numbers)
    table = Table("world", "revisits", "method", *COLUMNS)
    for key, counts in sums.items():
        table.add(*key, *_cells(np.sum(counts, axis=0)))


def _processor_s() -> float:
    """Processor time of this process and its children, in seconds."""
    times = os.times()
    return times.user + times.system + times.children_user + times.children_system


def _cells(numbers: Int[np.ndarray, " 10"]) -> list[str]:
    """Cells of `COLUMNS`."""
    scans, *counts, wrong, in_plane, recalled, revisits = numbers.tolist()
    known = Counts(*counts)
    recall = f"{recalled / revisits:.3f}" if revisits else ""
    return [*map(str, (scans, *known[:3])), known.recall, str(wrong), str(in_plane), recall]


def _pose_counts(drive: DescribedDrive, loops: Sequence[Any]) -> list[int]:
    """Wrong poses, those of them in the plane, revisits with a right pose, and revisits."""
    poses = np.array([one.match_from_query for one in loops])
    errors = pose_errors([(one.query, one.match) for one in loops], poses, drive.world_from_lidar)
    right = {loop.query for loop, is_right in zip(loops, errors.right, strict=True) if is_right}
    revisits, in_plane = set(np.flatnonzero(drive.revisits).tolist()), errors.wrong & (errors.storey_m <= STOREY_M)
    return [int(errors.wrong.sum()), int(in_plane.sum()), len(right & revisits), len(revisits)]


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
    session = found.sessions[0]
    pairs = [(one.query, one.match) for one in session.candidates]
    log_odds = found.model.log_odds(Evidence.stack([one.evidence for one in session.candidates]))
    for frame in sorted({*range(EXCLUDED_FRAMES, len(poses))} - {query for query, _ in pairs}):
        apart = np.linalg.norm(descriptors[: frame - EXCLUDED_FRAMES + 1] - descriptors[frame], axis=1)
        pairs.append((frame, int(apart.argmin())))
    log_odds = np.pad(log_odds, (0, len(pairs) - len(log_odds)), constant_values=NO_LOOP)
    kept = {(one.query, one.match) for one in found.loops}
    bonus = np.array([KEPT * (pair in kept) for pair in pairs])
    for title, scores in (("most probable", log_odds), ("most probable, loops first", log_odds + bonus)):
        best = {pairs[i][0]: i for i in np.argsort(scores, kind="stable").tolist()}
        queries = sorted(best)
        chosen = np.array([best[query] for query in queries])
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
