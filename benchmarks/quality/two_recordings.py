"""Find the transform between two recordings without a common frame: share within .2 m and .5 degrees, invented ones.

    python -m benchmarks.quality.session_pairs --seeds 1 2 3 --out build/sessions
    python -m benchmarks.quality.two_recordings build/sessions
    python -m benchmarks.quality.two_recordings build/sessions --odometry drifting --strangers 0

Reads the pairs that `session_pairs.py` has rendered. Each recording is searched, then the second one against the
first. The frame of a recording is that of its first scan. Strangers are recordings of different towns: the second
recording of a pair against the first one of the next pair.

The error of a transform is stated twice: at the origin of the second frame, and at the loops (median over the queries).
With drifting odometry (`loops.drifted`) or without odometry only the second one does not contain the drift.
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
from sglpr_jax.data import Record, Recording
from sglpr_jax.loops.candidates import CandidateFinder
from sglpr_jax.loops.detector import LoopDetector
from sglpr_jax.loops.find import FoundLoops
from sglpr_jax.loops.find_between import FoundBetween, between_searches
from sglpr_jax.loops.joint import settled
from sglpr_jax.loops.seen import Seen
from sglpr_jax.loops.transforms import inverse
from sglpr_jax.models.params import Params

OTHER_M = 20.0
"""A loop whose scans are farther apart is wrong."""
LIMIT_M, LIMIT_DEG = 0.2, 0.5

Search = tuple[FoundLoops, CandidateFinder]


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
        rows.append(row | judged(between_searches(0, 1, (first, second)), true))
        print(json.dumps(rows[-1]), flush=True)
        if before is not None and done < strangers:
            found = between_searches(0, 1, (first, before))
            done, invented = done + 1, invented + bool(found.aligned)
            print(f"  strangers: {len(found.loops)} loops, {len(found.aligned)} transforms", flush=True)
        before = second
    report(rows, invented, done)


def searched(params: Params, content: dict[str, np.ndarray], name: str, odometry: Odometry) -> Search:
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
    loops, rejected = settled(recording, detector.supported, given, detector.config, registered=False)
    found = FoundLoops(recording, len(times), tuple(loops), tuple(rejected), given, model=detector.model)
    return found, detector.finder


def judged(found: FoundBetween, true: list[Float[np.ndarray, "n 4 4"]]) -> dict[str, Any]:
    """Number of loops, wrong ones and transforms, and the errors of the first transform."""
    first, second = true
    wrong = [loop for loop in found.loops if np.linalg.norm(first[loop.match][:3, 3] - second[loop.query][:3, 3]) > OTHER_M]
    row = {"loops": len(found.loops), "wrong": len(wrong), "transforms": len(found.aligned)}
    if not found.aligned:
        return row
    aligned = found.aligned[0]
    parts = aligned.match, aligned.query
    frames = [poses[0 if part.is_odometry else part.first] for poses, part in zip(true, parts, strict=True)]
    expected = inverse(frames[0]) @ frames[1]
    error = inverse(expected) @ aligned.alignment.match_from_query
    metres, degrees = np.linalg.norm(error[:2, 3]), np.degrees(np.arctan2(error[1, 0], error[0, 0]))
    there = (inverse(frames[1]) @ second)[[loop.query for loop in found.loops]]
    here = inverse(expected @ there) @ aligned.alignment.match_from_query @ there
    sigma = np.sqrt(np.diag(aligned.alignment.covariance))
    return row | {
        "error_m": round(float(metres), 3),
        "error_deg": round(float(abs(degrees)), 3),
        "error_z_m": round(float(abs(error[2, 3])), 3),
        "at_loops_m": round(float(np.median(np.linalg.norm(here[:, :2, 3], axis=1))), 3),
        "sigma_m": round(float(np.hypot(*sigma[:2])), 3),
        "sigma_deg": round(float(np.degrees(sigma[5])), 3),
    }


def report(rows: list[dict[str, Any]], invented: int, strangers: int) -> None:
    """Print the shares."""
    aligned = [row for row in rows if row["transforms"]]
    turned = np.array([row["error_deg"] for row in aligned]) <= LIMIT_DEG
    print(f"{len(rows)} pairs, {len(aligned)} with a transform, {sum(row['wrong'] for row in rows)} wrong loops")
    for name in ("error_m", "at_loops_m"):
        metres = np.array([row[name] for row in aligned])
        fits = int(((metres <= LIMIT_M) & turned).sum())
        share = f"{fits} ({fits / max(len(rows), 1):.3f}) within {LIMIT_M:g} m and {LIMIT_DEG:g} degrees"
        print(f"{name}: {share}; median {np.median(metres):.3f} m, largest {metres.max(initial=0):.3f} m")
    print(f"{strangers} pairs of different towns: {invented} transforms")


if __name__ == "__main__":
    tyro.cli(main)
