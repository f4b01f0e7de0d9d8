"""Render pairs of short drives through one town, on two days, and store what the loop search keeps of each scan.

    python -m benchmarks.quality.session_pairs --seeds 1 2 3 --out build/sessions

The second drive has its own start and route. 50 to 100 m of it lie on streets of the first one, in either direction.
Parked cars and traffic differ. Each pair becomes a file SEED.npz with these arrays for both drives (first_*,
second_*), n scans each:

    descriptors (n, 256) float32, images (n, h, w) uint8, world_from_lidar (n, 4, 4), times (n,)
    common_m: length of the second drive within 4 m of the first; turned: median heading between them, in degrees

Files that exist are skipped.
"""

import dataclasses
import functools
import time
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path
from typing import NamedTuple

import jax
import numpy as np
import tyro
from jaxtyping import Int

import sglpr_jax
from sglpr_jax.files import replacing
from sglpr_jax.loops.candidates import CandidateFinder
from sglpr_jax.models.params import Params
from sglpr_jax.sim.drive import PlanarPath, drive_seed, plan_path
from sglpr_jax.sim.recording import SimulatedRecording, drive_through
from sglpr_jax.sim.routes import travelled
from sglpr_jax.sim.sensor import SENSORS, Sensor
from sglpr_jax.sim.sessions import PAUSE_S
from sglpr_jax.sim.world import build_world

ROUTES = ("00", "02", "05", "06", "07", "08", "10")
"""The seed chooses one."""
NEAR_M = 4.0
COMMON_M = (50.0, 100.0)
"""Length of the second drive near the first one."""
TRIES = 400


class Windows(NamedTuple):
    """Rows of the path at which the two drives take scans."""

    first: Int[np.ndarray, " n"]
    second: Int[np.ndarray, " n"]
    common_m: float
    turned_deg: float


def main(
    *,
    seeds: tuple[int, ...] = (1,),
    scans: int = 64,
    spacing_m: float = 2.0,
    sensor: str = "hdl64e",
    azimuth_steps: int = 900,
    weights: str = "sglpr",
    workers: int = 1,
    out: Path = Path("build/sessions"),
) -> None:
    """Render the pairs.

    Args:
        seeds: one town and pair for each.
        scans: number of scans of each drive.
        spacing_m: distance between them.
        sensor: name of the LiDAR.
        azimuth_steps: firings of the sensor per turn.
        weights: the model that describes the scans.
        workers: number of processes.
        out: the folder.
    """
    lidar = dataclasses.replace(SENSORS[sensor], azimuth_steps=azimuth_steps)
    work = functools.partial(write, scans=scans, spacing_m=spacing_m, sensor=lidar, weights=weights, out=out)
    out.mkdir(parents=True, exist_ok=True)
    left = [seed for seed in seeds if not (out / f"{seed}.npz").exists()]
    with ProcessPoolExecutor(workers, mp_context=get_context("spawn")) as pool:
        for number, line in enumerate(pool.map(work, left), 1):
            print(f"{number}/{len(left)} {line}", flush=True)


def write(seed: int, *, scans: int, spacing_m: float, sensor: Sensor, weights: str, out: Path) -> str:
    """Render a pair, write its file, and return a line about it."""
    begin, params = time.perf_counter(), sglpr_jax.load(weights)
    path, windows = plan(seed, scans=scans, spacing_m=spacing_m)
    seeds = drive_seed(seed, f"pair {seed}")
    world = build_world(seeds, path.xy, path.times)
    arrays = {}
    for day, (name, rows) in enumerate((("first", windows.first), ("second", windows.second))):
        drive = drive_through(
            world,
            path,
            rows,
            name=name,
            ids=tuple(f"{i:06d}" for i in range(len(rows))),
            times=path.times[rows] - path.times[rows[0]],
            sensor=sensor,
            key=jax.random.fold_in(jax.random.key(seed), day),
            rng=np.random.default_rng((*seeds, 2 + day)),
        )
        arrays |= {f"{name}_{key}": value for key, value in kept(drive, params).items()}
    with replacing(out / f"{seed}.npz") as temporary, temporary.open("wb") as file:
        np.savez_compressed(file, common_m=windows.common_m, turned_deg=windows.turned_deg, **arrays)
    about = f"{windows.common_m:.0f} m in common, turned by {windows.turned_deg:.0f} degrees"
    return f"{seed}.npz: {about}, {time.perf_counter() - begin:.1f} s"


def kept(drive: SimulatedRecording, params: Params) -> dict[str, np.ndarray]:
    """Descriptors, images, poses and times of a drive."""
    finder = CandidateFinder(params)
    seen = [finder.seen(drive.record(i, labels=False)) for i in range(len(drive))]
    return {
        "descriptors": np.stack([one.descriptor for one in seen]),
        "images": np.stack([one.image for one in seen]),
        "world_from_lidar": drive.poses.world_from_lidar,
        "times": drive.poses.times,
    }


def plan(seed: int, *, scans: int, spacing_m: float) -> tuple[PlanarPath, Windows]:
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
            turned = np.degrees(np.abs(_wrapped(path.yaw[b] - path.yaw[a][apart.argmin(axis=1)])))[near]
            return path, Windows(a, b, common_m, float(np.median(turned)))
    raise ValueError(f"seed {seed}: expected drives with {COMMON_M} m in common, found none in {TRIES} draws")


def _spaced(path: PlanarPath, rows: Int[np.ndarray, " n"], spacing_m: float) -> Int[np.ndarray, " k"]:
    """Rows about `spacing_m` apart."""
    way = travelled(path.xy[rows])
    return rows[np.searchsorted(way, np.arange(0, way[-1], spacing_m))]


def _window(rng: np.random.Generator, rows: Int[np.ndarray, " n"], scans: int) -> Int[np.ndarray, " k"]:
    start = int(rng.integers(max(len(rows) - scans, 1)))
    return rows[start : start + scans]


def _wrapped(angle: np.ndarray) -> np.ndarray:
    return (angle + np.pi) % (2 * np.pi) - np.pi


if __name__ == "__main__":
    tyro.cli(main)
