"""Find the transform between two recordings without a common frame: share within .2 m and .5 degrees, invented ones.

    python -m benchmarks.quality.session_pairs --seeds 1 2 3 --out build/sessions
    python -m benchmarks.quality.two_recordings build/sessions
    python -m benchmarks.quality.two_recordings build/sessions --odometry drifting --strangers 0

Reads the pairs that `session_pairs.py` has rendered. Each recording is searched, then the second one against the
first. The frame of a recording is that of its first scan. Strangers are recordings of different towns: the second
recording of a pair against the first one of the next pair.

The error of a transform is stated twice. `error_m` is that of the second frame's origin by the true poses; it contains
the drift of both recordings between their first scans and the loops. `at_loops_m` is that of the pose of a query in its
match by the transform and the poses that the search was given, the median over the loops.
"""

import json
from pathlib import Path
from typing import Any

import numpy as np
import tyro
from jaxtyping import Float

import sglpr_jax
from benchmarks.quality.drives import Odometry
from benchmarks.quality.loops import drifted
from sglpr_jax.data.recording import Record, Recording
from sglpr_jax.loops.acceptance import settled
from sglpr_jax.loops.closure import Loop
from sglpr_jax.loops.detector import LoopDetector
from sglpr_jax.loops.frame_alignment import AlignedParts
from sglpr_jax.loops.keyframes import Seen
from sglpr_jax.loops.search import Input, Searched, search_pair
from sglpr_jax.models.params import Params
from sglpr_jax.se3 import inverse, yaw_of

OTHER_M = 20.0
"""A loop whose scans are farther apart is wrong."""
LIMIT_M, LIMIT_DEG = 0.2, 0.5

Poses = Float[np.ndarray, "n 4 4"]


def main(
    pairs: tyro.conf.Positional[Path],
    *,
    odometry: Odometry = "exact",
    strangers: int = 20,
    seeds: tuple[int, ...] = (),
    weights: str = "sglpr",
) -> None:
    """Search the pairs and print the errors.

    Args:
        pairs: folder of `session_pairs.py`.
        odometry: poses that the search is given.
        strangers: number of pairs of different towns.
        seeds: pairs to search; without them all.
        weights: the model that described the scans.
    """
    params = sglpr_jax.load(weights)
    files = sorted(pairs.glob("*.npz"), key=lambda path: int(path.stem))
    files = [path for path in files if not seeds or int(path.stem) in seeds]
    rows, invented, before, done = [], 0, None, 0
    for path in files:
        with np.load(path) as file:
            content = dict(file)
        first, second = (searched(params, content, name, odometry) for name in ("first", "second"))
        true = [content[f"{name}_world_from_lidar"] for name in ("first", "second")]
        row = {"pair": path.stem, "common_m": float(content["common_m"]), "turned_deg": float(content["turned_deg"])}
        loops, _, transforms = search_pair(0, 1, (first, second))
        rows.append(row | judged(loops, transforms, (first, second), true))
        print(json.dumps(rows[-1]), flush=True)
        if before is not None and done < strangers:
            loops, _, transforms = search_pair(0, 1, (first, before))
            done, invented = done + 1, invented + bool(transforms)
            print(f"  strangers: {len(loops)} loops, {len(transforms)} transforms", flush=True)
        before = second
    report(rows, invented, done)


def searched(params: Params, content: dict[str, np.ndarray], name: str, odometry: Odometry) -> Searched:
    """Search one recording of a pair. Its frame is that of its first scan."""
    poses, times = content[f"{name}_world_from_lidar"], content[f"{name}_times"]
    drifting = drifted(poses, seed=int(1e3 * times[-1]))
    given = {"none": None, "exact": inverse(poses[0]) @ poses, "drifting": drifting}[odometry]
    detector = LoopDetector(params)
    shown = zip(content[f"{name}_descriptors"], content[f"{name}_images"], times.tolist(), strict=True)
    for i, (descriptor, image, time) in enumerate(shown):
        pose = None if given is None else given[i]
        detector.add_seen(Seen(descriptor, image, None), time=time, odometry=pose)
    recording = Recording(
        name=name,
        ids=tuple(f"{i:06d}" for i in range(len(times))),
        positions=None,
        times=times,
        pose_source=None,
        paths=tuple(Path(f"{i}") for i in range(len(times))),
        read=lambda path, labels, lasers: Record(),
    )
    loops, rejected = settled(recording, detector.loops, given, detector.config, registered=False)
    return Searched(Input(recording, given, detector.config), detector, loops, rejected)


def judged(
    loops: list[Loop], transforms: list[AlignedParts], searches: tuple[Searched, Searched], true: list[Poses]
) -> dict[str, Any]:
    """Number of loops, wrong ones and transforms, and the errors of the first transform."""
    seen = [inverse(true[0][loop.match]) @ true[1][loop.query] for loop in loops]
    wrong = sum(bool(np.linalg.norm(pose[:3, 3]) > OTHER_M) for pose in seen)
    row: dict[str, Any] = {"loops": len(loops), "wrong": wrong, "transforms": len(transforms)}
    if not transforms:
        return row
    aligned = transforms[0]
    parts, given = (aligned.match, aligned.query), []
    for part, one in zip(parts, searches, strict=True):
        poses = one.detector.finder.motion.poses if one.given.odometry is None else one.given.odometry
        given.append(poses if part.is_odometry else inverse(poses[part.first]) @ poses)
    frames = [poses[0 if part.is_odometry else part.first] for poses, part in zip(true, parts, strict=True)]
    match_from_query = aligned.alignment.match_from_query
    error = inverse(inverse(frames[0]) @ frames[1]) @ match_from_query
    here = [
        inverse(given[0][loop.match] @ pose) @ match_from_query @ given[1][loop.query]
        for loop, pose in zip(loops, seen, strict=True)
        if parts[1].first <= loop.query <= parts[1].last and parts[0].first <= loop.match <= parts[0].last
    ]
    sigma = np.sqrt(np.diag(aligned.alignment.covariance))
    numbers = {
        "error_m": np.linalg.norm(error[:2, 3]),
        "error_deg": np.degrees(abs(yaw_of(error))),
        "error_z_m": abs(error[2, 3]),
        "at_loops_m": np.median([np.linalg.norm(pose[:2, 3]) for pose in here]),
        "at_loops_deg": np.degrees(np.median([abs(yaw_of(pose)) for pose in here])),
        "sigma_m": np.hypot(*sigma[:2]),
        "sigma_deg": np.degrees(sigma[5]),
    }
    return row | {name: round(float(value), 3) for name, value in numbers.items()}


def report(rows: list[dict[str, Any]], invented: int, strangers: int) -> None:
    """Print the shares."""
    aligned = [row for row in rows if row["transforms"]]
    print(f"{len(rows)} pairs, {len(aligned)} with a transform, {sum(row['wrong'] for row in rows)} wrong loops")
    for where in ("error", "at_loops"):
        metres, degrees = (np.array([row[f"{where}_{unit}"] for row in aligned]) for unit in ("m", "deg"))
        fits = int(((metres <= LIMIT_M) & (degrees <= LIMIT_DEG)).sum())
        share = f"{fits} ({fits / max(len(rows), 1):.3f}) within {LIMIT_M:g} m and {LIMIT_DEG:g} degrees"
        most = f"largest {metres.max(initial=0):.3f} m and {degrees.max(initial=0):.3f} degrees"
        print(f"{where}: {share}; median {np.median(metres):.3f} m, {most}")
    print(f"{strangers} pairs of different towns: {invented} transforms")


if __name__ == "__main__":
    tyro.cli(main)
