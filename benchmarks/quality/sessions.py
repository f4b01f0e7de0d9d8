"""Transforms between two recordings of one town, without a common frame.

Pairs of short drives on two days are described (`described`) in files SEED-first.npz and SEED-second.npz. The second
drive has its own start and route; 50 to 100 m of it lie on streets of the first one, in either direction. Parked cars
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
from sglpr_jax.se3 import inverse, yaw_of
from sglpr_jax.sim.drive import PlanarPath, drive_seed, plan_path
from sglpr_jax.sim.recording import PAUSE_S, drive_through
from sglpr_jax.sim.routes import travelled
from sglpr_jax.sim.sensor import Sensor
from sglpr_jax.sim.world import build_world

ROUTES = ("00", "02", "05", "06", "07", "08", "10")
"""The seed chooses one."""
NEAR_M = 4.0
COMMON_M = (50.0, 100.0)
"""Length of the second drive near the first one."""
TRIES = 400
LIMIT_M, LIMIT_DEG = 0.2, 0.5
NAMES = ("first", "second")


class Windows(NamedTuple):
    """Rows of the path at which the two drives take scans."""

    rows: tuple[Int[np.ndarray, " n"], Int[np.ndarray, " n"]]
    common_m: float
    turned_deg: float


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
    """Find the transforms between pairs of drives, and invented ones between drives of different towns.

    The frame of a recording is that of its first scan. Strangers are the second recording of a pair and the first one
    of the next pair. `error_m` is the error of the second frame's origin by the true poses; it contains the drift of
    both recordings between their first scans and the loops. `at_loops_m` is the error of the pose of a query in its
    match by the transform and the given poses, the median over the loops.

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
    params, rows, invented, before, done = sglpr_jax.load(weights), [], 0, None, 0
    for seed in seeds:
        paths = [out / f"{seed}-{name}.npz" for name in NAMES]
        if not all(path.exists() for path in paths):
            path, windows = _plan(seed, scans=scans, spacing_m=spacing_m)
            _store(seed, path, windows, lidar(sensor, azimuth_steps), params, paths)
        first, second = (_read(path, drifting=odometry == "drifting") for path in paths)
        row = {"pair": seed, **first.facts, **_judged(_between(params, first, second), first, second)}
        rows.append(row)
        print(json.dumps(row), flush=True)
        if before is not None and done < strangers:
            found = _between(params, first, before)
            done, invented = done + 1, invented + bool(found.transforms)
            print(f"  strangers: {len(found.loops)} loops, {len(found.transforms)} transforms", flush=True)
        before = second
    _report(rows, invented, done)


def _store(
    seed: int, path: PlanarPath, windows: Windows, sensor: Sensor, params: sglpr_jax.Params, files: list[Path]
) -> None:
    """Render and describe a pair."""
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
    """The path of both days, and a window of each that share `COMMON_M` of street."""
    rng = np.random.default_rng((seed, 7))
    path = plan_path(rng, ROUTES[seed % len(ROUTES)], scans=600, days=2)
    day = np.arange(len(path.times)) * 2 // len(path.times)
    path = path._replace(times=path.times + PAUSE_S * day)
    first, second = (_spaced(path, np.flatnonzero(day == one), spacing_m) for one in (0, 1))
    for _ in range(TRIES):
        a, b = (_window(rng, rows, scans) for rows in (first, second))
        apart = np.linalg.norm(path.xy[b][:, None] - path.xy[a][None], axis=-1)
        near = apart.min(axis=1) <= NEAR_M
        common_m = float(near.sum() * spacing_m)
        if COMMON_M[0] <= common_m <= COMMON_M[1]:
            turned = (path.yaw[b] - path.yaw[a][apart.argmin(axis=1)] + np.pi) % (2 * np.pi) - np.pi
            return path, Windows((a, b), common_m, float(np.median(np.degrees(np.abs(turned))[near])))
    raise ValueError(f"seed {seed}: expected drives with {COMMON_M} m in common, found none in {TRIES} draws")


def _spaced(path: PlanarPath, rows: Int[np.ndarray, " n"], spacing_m: float) -> Int[np.ndarray, " k"]:
    """Rows about `spacing_m` apart."""
    way = travelled(path.xy[rows])
    return rows[np.searchsorted(way, np.arange(0, way[-1], spacing_m))]


def _window(rng: np.random.Generator, rows: Int[np.ndarray, " n"], scans: int) -> Int[np.ndarray, " k"]:
    start = int(rng.integers(max(len(rows) - scans, 1)))
    return rows[start : start + scans]


class Drive(NamedTuple):
    """A drive of a pair, with its true poses and those that the search is given."""

    recording: sglpr_jax.Recording
    true: Float[np.ndarray, "n 4 4"]
    given: Float[np.ndarray, "n 4 4"]
    facts: dict[str, float]
    """Length of the second drive within 4 m of the first, and median angle between their headings, in degrees."""


def _read(path: Path, *, drifting: bool) -> Drive:
    drive = described.read(path)
    true = drive.world_from_lidar
    given = drifted(true, seed=int(1e3 * drive.times[-1])) if drifting else inverse(true[0]) @ true
    facts = {name: float(drive.facts[name]) for name in ("common_m", "turned_deg")}
    return Drive(drive.recording, true, given, facts)


def _between(params: sglpr_jax.Params, first: Drive, second: Drive) -> Any:
    """Loops and transforms between two drives."""
    recordings, odometry = (first.recording, second.recording), (first.given, second.given)
    return sglpr_jax.find_loops(recordings, params, odometry=odometry, registered=False).between(0, 1)


def _judged(found: Any, first: Drive, second: Drive) -> dict[str, Any]:
    """Number of loops, wrong ones and transforms, and the errors of the transform."""
    true = [inverse(first.true[loop.match]) @ second.true[loop.query] for loop in found.loops]
    wrong = sum(bool(np.linalg.norm(pose[:3, 3]) > OTHER_M) for pose in true)
    row: dict[str, Any] = {"loops": len(found.loops), "wrong": wrong, "transforms": len(found.transforms)}
    if not found.transforms:
        return row
    alignment = found.transforms[0]
    error = inverse(inverse(first.true[0]) @ second.true[0]) @ alignment.match_from_query
    at_loops = [
        inverse(first.given[loop.match] @ pose) @ alignment.match_from_query @ second.given[loop.query]
        for loop, pose in zip(found.loops, true, strict=True)
    ]
    sigma = np.sqrt(np.diag(alignment.covariance))
    numbers = {
        "error_m": np.linalg.norm(error[:2, 3]),
        "error_deg": np.degrees(abs(yaw_of(error))),
        "error_z_m": abs(error[2, 3]),
        "at_loops_m": np.median([np.linalg.norm(pose[:2, 3]) for pose in at_loops]),
        "at_loops_deg": np.degrees(np.median([abs(yaw_of(pose)) for pose in at_loops])),
        "sigma_m": np.hypot(*sigma[:2]),
        "sigma_deg": np.degrees(sigma[5]),
    }
    return row | {name: round(float(value), 3) for name, value in numbers.items()}


def _report(rows: list[dict[str, Any]], invented: int, strangers: int) -> None:
    """Print the shares."""
    aligned = [row for row in rows if row["transforms"]]
    print(f"{len(rows)} pairs, {len(aligned)} with a transform, {sum(row['wrong'] for row in rows)} wrong loops")
    for where in ("error", "at_loops") if aligned else ():
        metres, degrees = (np.array([row[f"{where}_{unit}"] for row in aligned]) for unit in ("m", "deg"))
        fits = int(((metres <= LIMIT_M) & (degrees <= LIMIT_DEG)).sum())
        share = f"{fits} ({fits / len(rows):.3f}) within {LIMIT_M:g} m and {LIMIT_DEG:g} degrees"
        most = f"largest {metres.max():.3f} m and {degrees.max():.3f} degrees"
        print(f"{where}: {share}; median {np.median(metres):.3f} m, {most}")
    print(f"{strangers} pairs of different towns: {invented} transforms")
