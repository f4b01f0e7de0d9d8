"""Find loops where places repeat: wrong loops, recall and reliability by scenery, without and with odometry.

    python -m benchmarks.quality.repeating_scans --seeds 13 14 --out build/test
    python -m benchmarks.quality.repeating build/test
    python -m benchmarks.quality.repeating build/test --odometry drifting --sensors vlp16
    python -m benchmarks.quality.repeating build/test --odometry exact --sceneries rooms corridor car_park --optimized

Reads the drives that `repeating_scans.py` has rendered. A loop is wrong if its pose is wrong (`drives.PoseErrors`).
Revisits are scans within 3 m of one on the same storey from which at least 30 m were travelled. Odometry is the true
poses, exact or with drift (`loops.drifted`). Results are kept beside the drives, in `found-ODOMETRY.jsonl`; with the
same model and settings, a drive is searched once.
"""

import dataclasses
import functools
import hashlib
import json
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np
import tyro
from jaxtyping import Bool, Float
from rich.console import Console
from rich.table import Table

import sglpr_jax
from benchmarks.quality.drives import STOREY_M, Odometry, compared, pose_errors, read
from sglpr_jax.loops.acceptance import accepted
from sglpr_jax.loops.closure import Loop
from sglpr_jax.loops.detector import LoopDetector
from sglpr_jax.pose_graph import optimize
from sglpr_jax.pose_graph.optimize import trajectory_error

REVISIT_M, WAY_M = 3.0, 30.0


def main(
    drives: tyro.conf.Positional[Path],
    *,
    odometry: Odometry = "none",
    optimized: bool = False,
    sceneries: tuple[str, ...] = (),
    sensors: tuple[str, ...] = (),
    seeds: tuple[int, ...] = (),
    weights: str = "sglpr",
    workers: int = 1,
) -> None:
    """Search the drives and print the tables.

    Args:
        drives: folder of `repeating_scans.py`.
        odometry: what the detector is given.
        optimized: correct the odometry by the loops, and print how far that moved it and its error before and after
            (extra gtsam).
        sceneries: those to search; without them all.
        sensors: likewise.
        seeds: likewise.
        weights: the model that described the scans.
        workers: number of processes.
    """
    found = drives / f"found-{odometry}{'-optimized' * optimized}.jsonl"
    settings = _settings(weights)
    files = [path for path in sorted(drives.glob("*.npz")) if _chosen(path, sceneries, sensors, seeds)]
    done = {row["drive"]: row for row in _rows(found) if row["settings"] == settings}
    left = [path for path in files if path.stem not in done]
    search = functools.partial(searched, odometry=odometry, optimized=optimized, weights=weights)
    with ProcessPoolExecutor(workers, mp_context=get_context("spawn")) as pool, found.open("a") as lines:
        for number, row in enumerate(pool.map(search, left), 1):
            done[row["drive"]] = row | {"settings": settings}
            lines.write(json.dumps(done[row["drive"]]) + "\n")
            lines.flush()
            print(f"{number}/{len(left)} {row['drive']}: {row['loops']} loops, {row['wrong']} wrong", flush=True)
    report([done[path.stem] for path in files])


def _chosen(path: Path, sceneries: Sequence[str], sensors: Sequence[str], seeds: Sequence[int]) -> bool:
    scenery, _, rest = path.stem.split("-", 2)
    sensor, seed = rest.rsplit("-", 1)
    wanted = ((scenery, sceneries), (sensor, sensors), (int(seed), seeds))
    return all(not some or one in some for one, some in wanted)


def _settings(weights: str) -> str:
    """Names the model of the probabilities and all settings of the detector."""
    detector = LoopDetector(sglpr_jax.load(weights))
    about = json.dumps([detector.model.to_json(), dataclasses.asdict(detector.config)])
    return hashlib.sha256(about.encode()).hexdigest()[:16]


def _rows(path: Path) -> Iterator[dict[str, Any]]:
    if path.exists():
        yield from map(json.loads, path.read_text().splitlines())


def searched(path: Path, *, odometry: Odometry, optimized: bool, weights: str) -> dict[str, Any]:
    """The loops of one drive, judged by the true poses."""
    params, drive = sglpr_jax.load(weights), read(path)
    poses, times = drive.world_from_lidar, drive.times
    given = drive.odometry(odometry)
    detector = LoopDetector(params)
    frames = compared(drive, params, path.parent / "compared", odometry=odometry)
    for i, (seen, frame) in enumerate(zip(drive.seen, frames, strict=True)):
        pose = None if given is None else given[i]
        detector.add_seen(seen, time=float(times[i]), odometry=pose, compared=frame)
    drift = detector.finder.present_drift
    loops = detector.loops if given is None else accepted(detector.loops, given, drift=drift)[0]
    revisited = revisits(poses[:, :3, 3], REVISIT_M * drive.scale, WAY_M * drive.scale)
    errors = pose_errors(
        [(one.query, one.match) for one in loops], np.array([one.match_from_query for one in loops]), poses
    )
    right = {loop.query for loop, ok in zip(loops, errors.right, strict=True) if ok}
    moved = _moved(given, loops, poses) if optimized and given is not None else {}
    return {
        "drive": path.stem,
        **drive.about,
        "scans": len(poses),
        "loops": len(loops),
        "wrong": int(errors.wrong.sum()),
        "in_plane": int((errors.wrong & (errors.storey_m <= STOREY_M)).sum()),
        "sure_of_wrong": _surest(loops, errors.wrong),
        "revisits": int(revisited.sum()),
        "found": int(sum(frame in right for frame in np.flatnonzero(revisited))),
        **moved,
    }


def _moved(
    odometry: Float[np.ndarray, "n 4 4"], loops: Sequence[Loop], poses: Float[np.ndarray, "n 4 4"]
) -> dict[str, float]:
    """How far the optimisation moves the odometry at most, and its RMS error before and after, in metres."""
    corrected = optimize.PoseGraph({0: odometry}, loops).solve()
    before, after = (trajectory_error(each, poses[:, :3, 3]) for each in (odometry, corrected.poses))
    return {"moved_m": corrected.moved_m, "before_m": before, "after_m": after}


def _surest(loops: Sequence[Loop], wrong: Bool[np.ndarray, " n"]) -> float:
    return max((loop.probability for loop, is_wrong in zip(loops, wrong, strict=True) if is_wrong), default=0.0)


def revisits(positions: Float[np.ndarray, "n 3"], near_m: float, way_m: float) -> Bool[np.ndarray, " n"]:
    """Which scans come near an earlier one after at least `way_m` metres of travelled distance."""
    way = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(positions, axis=0), axis=1))])
    found = np.zeros(len(positions), bool)
    for i, position in enumerate(positions):
        old = positions[way <= way[i] - way_m]
        found[i] = len(old) > 0 and np.linalg.norm(old - position, axis=1).min() < near_m
    return found


def report(rows: Sequence[dict[str, Any]]) -> None:
    """Print a table by scenery for each kind of drive, and what it comes to."""
    for revisit in dict.fromkeys(row["revisit"] for row in rows):
        table = Table("scenery", "scans", "loops", "wrong", "of these in the plane", "recall", title=revisit)
        chosen = [row for row in rows if row["revisit"] == revisit]
        for scenery in (*dict.fromkeys(row["scenery"] for row in chosen), "all"):
            some = [row for row in chosen if scenery in ("all", row["scenery"])]
            total = {name: sum(row[name] for row in some) for name in some[0] if isinstance(some[0][name], int)}
            recall = f"{total['found'] / total['revisits']:.3f}" if total["revisits"] else ""
            counts = (total["scans"], total["loops"], total["wrong"], total["in_plane"], recall)
            table.add_row(scenery, *map(str, counts))
        Console().print(table)
    for row in rows:
        if "moved_m" in row:
            moved = "moved by {moved_m:.2f} m, error {before_m:.2f} m before, {after_m:.2f} m after".format(**row)
            print(f"{row['drive']}: {row['loops']} loops, {moved}")


if __name__ == "__main__":
    tyro.cli(main)
