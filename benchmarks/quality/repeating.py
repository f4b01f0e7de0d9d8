"""Find loops where places repeat: wrong loops, recall and reliability by scenery, without and with odometry.

    python -m benchmarks.quality.repeating_scans --seeds 13 14 --out build/test
    python -m benchmarks.quality.repeating build/test
    python -m benchmarks.quality.repeating build/test --odometry drifting --sensors vlp16
    python -m benchmarks.quality.repeating build/test --odometry exact --sceneries rooms corridor car_park --optimized

Reads the drives that `repeating_scans.py` has rendered. A loop is wrong if its scans are farther apart than the
scenery's `other_m`: 20 m outdoors, 4 to 9 m indoors. Revisits are scans within half of that (at most 5 m) of one
that is 30 s older. Odometry is the true poses, exact or with drift (`loops.drifted`). Results are kept beside the
drives, in `found-ODOMETRY.jsonl`; with the same model and settings, a drive is searched once.
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
from benchmarks.quality.drives import Odometry, compared, distances, read
from sglpr_jax.loops import optimization
from sglpr_jax.loops.candidates import CandidateFinder
from sglpr_jax.loops.detector import LoopDetector
from sglpr_jax.loops.joint import accepted
from sglpr_jax.loops.loop import Loop
from sglpr_jax.loops.optimization import trajectory_error

REVISIT_M, AGE_S = 5.0, 30.0
SURE = 0.99


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
    poses, times, other_m = drive.world_from_lidar, drive.times, drive.other_m
    given = drive.odometry(odometry)
    detector = LoopDetector(params)
    frames = compared(drive, CandidateFinder(params), path.parent / "compared", odometry=odometry)
    for i, (seen, frame) in enumerate(zip(drive.seen, frames, strict=True)):
        pose = None if given is None else given[i]
        detector.add_seen(seen, time=float(times[i]), odometry=pose, compared=frame)
    loops = detector.loops if given is None else accepted(detector.supported, given)[0]
    revisited = revisits(poses[:, :3, 3], times, min(REVISIT_M * drive.scale, other_m / 2))
    apart = distances([(loop.query, loop.match) for loop in loops], poses)
    right = {loop.query for loop, metres in zip(loops, apart, strict=True) if metres <= other_m}
    pairs = distances([(one.query, one.match) for one in detector.candidates], poses)
    sure = np.array([float(detector.model.probability(one.evidence)) >= SURE for one in detector.candidates], bool)
    moved = _moved(given, loops, poses) if optimized and given is not None else {}
    return {
        "drive": path.stem,
        **drive.about,
        "scans": len(poses),
        "loops": len(loops),
        "wrong": int((apart > other_m).sum()),
        "sure_of_wrong": _surest(loops, apart > other_m),
        "revisits": int(revisited.sum()),
        "found": int(sum(frame in right for frame in np.flatnonzero(revisited))),
        "sure_pairs": int((sure & ((pairs <= other_m / 2) | (pairs > other_m))).sum()),
        "sure_loops": int((sure & (pairs <= other_m / 2)).sum()),
        **moved,
    }


def _moved(
    odometry: Float[np.ndarray, "n 4 4"], loops: Sequence[Loop], poses: Float[np.ndarray, "n 4 4"]
) -> dict[str, float]:
    """How far the optimisation moves the odometry at most, and its RMS error before and after, in metres."""
    corrected = optimization.optimized(odometry, tuple(loops))
    before, after = (trajectory_error(each, poses[:, :3, 3]) for each in (odometry, corrected.poses))
    return {"moved_m": corrected.moved_m, "before_m": before, "after_m": after}


def _surest(loops: Sequence[Loop], wrong: Bool[np.ndarray, " n"]) -> float:
    return max((loop.probability for loop, is_wrong in zip(loops, wrong, strict=True) if is_wrong), default=0.0)


def revisits(positions: Float[np.ndarray, "n 3"], times: Float[np.ndarray, " n"], near_m: float) -> np.ndarray:
    """Which scans come near one that is `AGE_S` older."""
    found = np.zeros(len(positions), bool)
    for i, (position, time) in enumerate(zip(positions, times, strict=True)):
        old = positions[times <= time - AGE_S]
        found[i] = len(old) > 0 and np.linalg.norm(old - position, axis=1).min() < near_m
    return found


def report(rows: Sequence[dict[str, Any]]) -> None:
    """Print a table by scenery for each kind of drive, and what it comes to."""
    for revisit in dict.fromkeys(row["revisit"] for row in rows):
        table = Table(
            "scenery", "scans", "loops", "wrong", "recall", f"pairs >= {SURE}", "of which loops", title=revisit
        )
        chosen = [row for row in rows if row["revisit"] == revisit]
        for scenery in (*dict.fromkeys(row["scenery"] for row in chosen), "all"):
            some = [row for row in chosen if scenery in ("all", row["scenery"])]
            total = {name: sum(row[name] for row in some) for name in some[0] if isinstance(some[0][name], int)}
            recall = f"{total['found'] / total['revisits']:.3f}" if total["revisits"] else ""
            counts = (total["scans"], total["loops"], total["wrong"], recall, total["sure_pairs"], total["sure_loops"])
            table.add_row(scenery, *map(str, counts))
        Console().print(table)
    for row in rows:
        if "moved_m" in row:
            moved = "moved by {moved_m:.2f} m, error {before_m:.2f} m before, {after_m:.2f} m after".format(**row)
            print(f"{row['drive']}: {row['loops']} loops, {moved}")


if __name__ == "__main__":
    tyro.cli(main)
