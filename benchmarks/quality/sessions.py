"""Benchmark of transforms between two recordings of one town, without a common frame.

Pairs of short drives on two days are stored by `described` in files SEED-first.npz and SEED-second.npz. The second
drive has another start and route. 50 to 100 m of it are on streets of the first one, in either direction. Parked cars
and traffic differ.
"""

import json
from pathlib import Path
from typing import Any, Literal, NamedTuple

import jax
import numpy as np
from jaxtyping import Float, Int

import sglpr_jax
from benchmarks import described
from benchmarks.drives import drifted, lidar
from benchmarks.quality.scoring import OTHER_M
from sglpr_jax.se3 import inverse, lengths_along, wrap_angle, yaw_of
from sglpr_jax.sim.drive import PlanarPath, drive_seed, plan_path
from sglpr_jax.sim.recording import PAUSE_S, drive_through
from sglpr_jax.sim.sensor import Sensor
from sglpr_jax.sim.world import build_world

ROUTES = ("00", "02", "05", "06", "07", "08", "10")
"""Routes of which the seed chooses one."""
NEAR_M = 4.0  # maximum distance of two scans on the same street, in metres
COMMON_M = (50.0, 100.0)
"""Range of the length of the second drive on streets of the first one, in metres."""
TRIES = 400  # maximum number of draws of a pair
LIMIT_M, LIMIT_DEG = 0.2, 0.5  # largest errors of an accurate transform
NAMES = ("first", "second")


class Windows(NamedTuple):
    """Poses of a path at which the two drives of a pair take scans."""

    rows: tuple[Int[np.ndarray, " n"], Int[np.ndarray, " n"]]  # indices in the path
    common_m: float  # length of the second drive on streets of the first one
    turned_deg: float  # median angle between the headings on these streets


def sessions(
    *,
    seeds: tuple[int, ...] = (1,),
    odometry: Literal["exact", "drifting"] = "exact",
    strangers: int = 20,
    scans: int = 64,
    spacing_m: float = 2.0,
    sensor: str = "hdl64e",
    azimuth_steps: int = 900,
    weights: str = "sglpr",
    out: Path = Path("build/sessions"),
) -> None:
    """Find the transforms between pairs of drives, and wrong transforms between drives of different towns.

    The frame of a recording is that of its first scan. A pair of strangers is the first recording of a pair and the
    second one of the pair before. `error_m` is the error of the origin of the second frame. It contains the drift of
    both recordings between their first scans and the loops. `at_loops_m` is the error of the pose of a query in its
    match by the transform and the given odometry, as the median over the loops.

    Args:
        seeds: one town and pair for each.
        odometry: poses that the search is given.
        strangers: number of pairs of different towns.
        scans: number of scans of each drive.
        spacing_m: distance between them.
        sensor: name of the LiDAR.
        azimuth_steps: firings of the sensor per turn.
        weights: the model that describes the images.
        out: folder of the described drives. Those that exist are not rendered again.
    """
    params, rows = sglpr_jax.load(weights), []
    wrong_transforms, searched_strangers, previous_second = 0, 0, None
    for seed in seeds:
        paths = [out / f"{seed}-{name}.npz" for name in NAMES]
        if not all(path.exists() for path in paths):
            path, windows = _plan(seed, scans=scans, spacing_m=spacing_m)
            _store(seed, path, windows, lidar(sensor, azimuth_steps), params, paths)
        first, second = (_read(path, drifting=odometry == "drifting") for path in paths)
        row = {"pair": seed, **first.facts, **_errors(_search(params, first, second), first, second)}
        rows.append(row)
        print(json.dumps(row), flush=True)
        if previous_second is not None and searched_strangers < strangers:
            result = _search(params, first, previous_second)
            searched_strangers += 1
            wrong_transforms += bool(result.transforms)
            print(f"  strangers: {len(result.loops)} loops, {len(result.transforms)} transforms", flush=True)
        previous_second = second
    _report(rows, wrong_transforms, searched_strangers)


def _store(
    seed: int, path: PlanarPath, windows: Windows, sensor: Sensor, params: sglpr_jax.Params, files: list[Path]
) -> None:
    """Renders and describes both drives of a pair, and writes their files."""
    seeds = drive_seed(seed, f"pair {seed}")
    world = build_world(seeds, path.xy, path.times)
    for day, (file, rows) in enumerate(zip(files, windows.rows, strict=True)):
        drive = drive_through(
            world,
            path,
            rows,
            name=file.stem,
            times=path.times[rows] - path.times[rows[0]],
            sensor=sensor,
            key=jax.random.fold_in(jax.random.key(seed), day),
            rng=np.random.default_rng((*seeds, 2 + day)),
        )
        described.store(file, drive, params, common_m=windows.common_m, turned_deg=windows.turned_deg)


def _plan(seed: int, *, scans: int, spacing_m: float) -> tuple[PlanarPath, Windows]:
    """Plans the path of both days, and draws a part of each day. The parts share `COMMON_M` metres of street."""
    rng = np.random.default_rng((seed, 7))
    path = plan_path(rng, ROUTES[seed % len(ROUTES)], scans=600, days=2)
    day = np.arange(len(path.times)) * 2 // len(path.times)
    path = path._replace(times=path.times + PAUSE_S * day)
    first_day, second_day = (_spaced_rows(path, np.flatnonzero(day == k), spacing_m) for k in (0, 1))
    for _ in range(TRIES):
        first, second = (_random_window(rng, rows, scans) for rows in (first_day, second_day))
        distance = np.linalg.norm(path.xy[second][:, None] - path.xy[first][None], axis=-1)
        is_near = distance.min(axis=1) <= NEAR_M
        common_m = float(is_near.sum() * spacing_m)
        if COMMON_M[0] <= common_m <= COMMON_M[1]:
            nearest = distance.argmin(axis=1)
            turn = wrap_angle(path.yaw[second] - path.yaw[first][nearest])
            return path, Windows((first, second), common_m, float(np.median(np.degrees(np.abs(turn))[is_near])))
    raise ValueError(f"seed {seed}: expected drives with {COMMON_M} m in common, found none in {TRIES} draws")


def _spaced_rows(path: PlanarPath, rows: Int[np.ndarray, " n"], spacing_m: float) -> Int[np.ndarray, " k"]:
    """Selects rows of the path that are about `spacing_m` apart."""
    length_m = lengths_along(path.xy[rows])
    return rows[np.searchsorted(length_m, np.arange(0, length_m[-1], spacing_m))]


def _random_window(rng: np.random.Generator, rows: Int[np.ndarray, " n"], scans: int) -> Int[np.ndarray, " k"]:
    """Up to `scans` successive rows with a random start."""
    start = int(rng.integers(max(len(rows) - scans, 1)))
    return rows[start : start + scans]


class Drive(NamedTuple):
    """Drive of a pair, with its true poses and the odometry for the search."""

    recording: sglpr_jax.Recording
    true_poses: Float[np.ndarray, "n 4 4"]
    odometry: Float[np.ndarray, "n 4 4"]
    facts: dict[str, float]
    """Fields `common_m` and `turned_deg` of `Windows`."""


def _read(path: Path, *, drifting: bool) -> Drive:
    """Reads a drive. Its odometry starts at the identity."""
    drive = described.read(path)
    poses = drive.world_from_lidar
    odometry = drifted(poses, seed=int(1e3 * drive.times[-1])) if drifting else inverse(poses[0]) @ poses
    facts = {name: float(drive.facts[name]) for name in ("common_m", "turned_deg")}
    return Drive(drive.recording, poses, odometry, facts)


def _search(params: sglpr_jax.Params, first: Drive, second: Drive) -> Any:
    """Loops and transforms between two drives. Matches are in the first one, queries in the second one."""
    recordings, odometry = (first.recording, second.recording), (first.odometry, second.odometry)
    return sglpr_jax.find_loops(recordings, params, odometry=odometry, registered=False).between(0, 1)


def _errors(result: Any, first: Drive, second: Drive) -> dict[str, Any]:
    """Numbers of loops, wrong loops and transforms, and the errors of the first transform."""
    true_poses = [inverse(first.true_poses[loop.match]) @ second.true_poses[loop.query] for loop in result.loops]
    wrong = sum(bool(np.linalg.norm(pose[:3, 3]) > OTHER_M) for pose in true_poses)
    row: dict[str, Any] = {"loops": len(result.loops), "wrong": wrong, "transforms": len(result.transforms)}
    if not result.transforms:
        return row
    alignment = result.transforms[0]
    error = inverse(inverse(first.true_poses[0]) @ second.true_poses[0]) @ alignment.match_from_query
    errors_at_loops = [
        inverse(first.odometry[loop.match] @ pose) @ alignment.match_from_query @ second.odometry[loop.query]
        for loop, pose in zip(result.loops, true_poses, strict=True)
    ]
    sigma = np.sqrt(np.diag(alignment.covariance))
    metrics = {
        "error_m": np.linalg.norm(error[:2, 3]),
        "error_deg": np.degrees(abs(yaw_of(error))),
        "error_z_m": abs(error[2, 3]),
        "at_loops_m": np.median([np.linalg.norm(pose[:2, 3]) for pose in errors_at_loops]),
        "at_loops_deg": np.degrees(np.median([abs(yaw_of(pose)) for pose in errors_at_loops])),
        "sigma_m": np.hypot(*sigma[:2]),
        "sigma_deg": np.degrees(sigma[5]),
    }
    return row | {name: round(float(value), 3) for name, value in metrics.items()}


def _report(rows: list[dict[str, Any]], wrong_transforms: int, strangers: int) -> None:
    """Prints the numbers of transforms, the share of accurate ones, and their errors."""
    aligned = [row for row in rows if row["transforms"]]
    print(f"{len(rows)} pairs, {len(aligned)} with a transform, {sum(row['wrong'] for row in rows)} wrong loops")
    for metric in ("error", "at_loops") if aligned else ():
        metres, degrees = (np.array([row[f"{metric}_{unit}"] for row in aligned]) for unit in ("m", "deg"))
        accurate = int(((metres <= LIMIT_M) & (degrees <= LIMIT_DEG)).sum())
        share = f"{accurate} ({accurate / len(rows):.3f}) within {LIMIT_M:g} m and {LIMIT_DEG:g} degrees"
        largest = f"largest {metres.max():.3f} m and {degrees.max():.3f} degrees"
        print(f"{metric}: {share}; median {np.median(metres):.3f} m, {largest}")
    print(f"{strangers} pairs of different towns: {wrong_transforms} transforms")
