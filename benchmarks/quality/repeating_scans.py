"""Render drives through sceneries where places repeat, and store what the loop detector keeps of each scan.

    python -m benchmarks.quality.repeating_scans --seeds 1 2 --out build/repeating
    python -m benchmarks.quality.repeating_scans --sceneries tunnel town --sensors vlp16 --revisits none

Each drive becomes a file SCENERY-REVISIT-SENSOR-SEED.npz with these arrays, n scans each:

    descriptors (n, 256) float32, images (n, h, w) uint8, world_from_lidar (n, 4, 4), times (n,)
    scenery, sensor, revisit: names; seed; other_m: frames farther apart than this show different places
    scale: factor for lengths of the images; poses and other_m are in real metres

A sensor with a plus sign, such as os0-32+backpack, is carried by one of `CARRIERS`. Files that exist are skipped. The
towns are `simulate_recording`'s, on a route that has these revisits.
"""

import dataclasses
import itertools
import time
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path
from typing import NamedTuple

import numpy as np
import tyro

import sglpr_jax
from sglpr_jax.data.choices import Scale
from sglpr_jax.data.scaled import scaled
from sglpr_jax.files import replacing
from sglpr_jax.loops.candidates import CandidateFinder
from sglpr_jax.sim.drive import CARRIERS
from sglpr_jax.sim.recording import SimulatedRecording, simulate_recording
from sglpr_jax.sim.repeating import simulate_repeating
from sglpr_jax.sim.routes import REVISITS, Revisit
from sglpr_jax.sim.sceneries import REPEATING
from sglpr_jax.sim.sensor import HDL64E, SENSORS
from sglpr_jax.sim.styles import SCENERIES

ROUTES: dict[Revisit, tuple[str, ...]] = {"none": ("01", "04"), "same": ("06", "00"), "opposite": ("08",)}
"""Routes of the towns; the seed chooses."""
HIDDEN_DEG = (60.0, 300.0, 91.0)
"""Azimuths that a sensor of 120 degrees does not see, and the elevation below which they are hidden."""
LIDARS = {
    **{name: SENSORS[name] for name in ("hdl64e", "hdl32e", "vlp16", "os0-32")},
    "hdl64e-120": dataclasses.replace(HDL64E, shadows_deg=(HIDDEN_DEG,)),
    "os0-32-140": dataclasses.replace(SENSORS["os0-32"], azimuths_deg=(-70.0, 70.0)),
}
CARS, WALKERS = ("hdl64e", "vlp16"), ("os0-32+backpack", "os0-32-140+handheld")
OF_SCENERY: dict[str, tuple[str, ...]] = {
    **dict.fromkeys(("hall", "yard"), WALKERS),
    **dict.fromkeys(("campus", "warehouse"), (*CARS, "os0-32+cart")),
    "forest": (*CARS, "os0-32+backpack"),
    "storeys": ("hdl32e", "vlp16"),
}
"""Sensors of a scenery, if they are not `CARS`."""
OTHER_M = 20.0
"""In towns, frames farther apart than this show different places."""


class Drive(NamedTuple):
    """One file."""

    scenery: str
    revisit: Revisit
    sensor: str
    seed: int

    @property
    def file(self) -> str:
        return "-".join(map(str, self)) + ".npz"


def main(
    *,
    sceneries: tuple[str, ...] = (*REPEATING, *SCENERIES),
    seeds: tuple[int, ...] = (1,),
    sensors: tuple[str, ...] = (),
    revisits: tuple[Revisit, ...] = REVISITS,
    scans: int = 300,
    azimuth_steps: int = 900,
    scale: Scale = 1,
    weights: str = "sglpr",
    workers: int = 1,
    out: Path = Path("build/repeating"),
) -> None:
    """Render the drives.

    Args:
        sceneries: names of sceneries that repeat, and of towns.
        seeds: one drive for each.
        sensors: names in `LIDARS`, with a plus sign and a carrier if it is not a vehicle. By default those of the
            scenery.
        revisits: whether and how the vehicle returns.
        scans: number of scans of each drive.
        azimuth_steps: firings of the sensor per turn.
        scale: factor for all lengths before a scan is described; another scale needs another folder.
        weights: the model that describes the scans.
        workers: number of processes.
        out: the folder.
    """
    drives = [
        Drive(scenery, revisit, sensor, seed)
        for seed, revisit, scenery in itertools.product(seeds, revisits, sceneries)
        for sensor in sensors or OF_SCENERY.get(scenery, CARS)
    ]
    drives = [drive for drive in drives if not (out / drive.file).exists()]
    with ProcessPoolExecutor(workers, mp_context=get_context("spawn")) as pool:
        count = len(drives)
        work = pool.map(write, drives, *([value] * count for value in (scans, azimuth_steps, scale, weights, out)))
        for number, line in enumerate(work, 1):
            print(f"{number}/{count} {line}", flush=True)


def write(drive: Drive, scans: int, azimuth_steps: int, scale: Scale, weights: str, out: Path) -> str:
    """Render a drive, write its file, and return a line about it."""
    if (out / drive.file).exists():
        return f"{drive.file}: exists"
    begin = time.perf_counter()
    simulated = record(drive, scans, azimuth_steps)
    recording = scaled(simulated, scale)
    finder = CandidateFinder(sglpr_jax.load(weights))
    seen = [finder.seen(recording.record(i, labels=False)) for i in range(len(recording))]
    town = drive.scenery in SCENERIES
    with replacing(out / drive.file) as temporary, temporary.open("wb") as file:
        np.savez_compressed(
            file,
            descriptors=np.stack([one.descriptor for one in seen]),
            images=np.stack([one.image for one in seen]),
            world_from_lidar=simulated.poses.world_from_lidar,
            times=simulated.poses.times,
            scale=np.array(scale),
            other_m=OTHER_M if town else REPEATING[drive.scenery].other_m,
            **{name: np.array(value) for name, value in drive._asdict().items()},
        )
    seconds, empty = time.perf_counter() - begin, np.mean([finder.is_empty(one.image) for one in seen])
    return f"{drive.file}: {len(seen)} scans in {seconds:.1f} s, {empty:.0%} nearly empty"


def record(drive: Drive, scans: int, azimuth_steps: int) -> SimulatedRecording:
    """The recording of a drive."""
    lidar, _, carrier = drive.sensor.partition("+")
    sensor = dataclasses.replace(LIDARS[lidar], azimuth_steps=azimuth_steps)
    moved = {"seed": drive.seed, "sensor": sensor, "carrier": CARRIERS[carrier or "vehicle"]}
    if drive.scenery not in SCENERIES:
        return simulate_repeating(drive.scenery, scans=scans, revisit=drive.revisit, **moved)
    routes = ROUTES[drive.revisit]
    route, town = routes[drive.seed % len(routes)], SCENERIES[drive.scenery]
    return simulate_recording(route, scans=scans, scenery=town, **moved)


if __name__ == "__main__":
    tyro.cli(main)
