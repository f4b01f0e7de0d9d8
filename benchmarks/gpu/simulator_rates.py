"""How fast this device makes scans of a simulated town, and images of clouds: one row each."""

import concurrent.futures
import functools
from collections.abc import Callable, Iterator
from typing import Any

import jax
import numpy as np

from benchmarks.speed.inputs import random_scans
from benchmarks.timing import median_seconds
from sglpr_jax.bev import rasterize
from sglpr_jax.data.density_image import density_bev
from sglpr_jax.grid import Grid
from sglpr_jax.sim.drive import plan_path, poses_on, scan_rows
from sglpr_jax.sim.sensor import Sensor, cast_turn, first_surface, returned_points, scan, view_of
from sglpr_jax.sim.world import build_world

GRID = Grid(height=224, width=224)
"""The paper's, onto which clouds are rasterised."""
BATCH, POINTS, REPEATS = 16, 120_000, 10
"""Scans and clouds in one call, points of a cloud, and how often everything is timed."""
Row = dict[str, Any]


class TownDrive:
    """A drive through its town, and the sensor that makes it."""

    def __init__(self, route: str, scans: int, sensor: Sensor):
        path = plan_path(np.random.default_rng(0), route, scans=scans)
        xy, yaw, self.times = (values[scan_rows(path, scans)] for values in path)
        self.world = build_world(0, xy, self.times)
        self.poses = poses_on(self.world.ground.relief, xy, yaw, height_m=sensor.height_m)
        self.sensor, self.key = sensor, jax.random.key(0)

    def view(self, i: int) -> Any:
        """What the rays of a scan may meet."""
        return view_of(self.world, self.poses[i], sensor=self.sensor, time=float(self.times[i]))

    def scan(self, i: int) -> tuple[np.ndarray, np.ndarray]:
        """A scan from the town to the host's memory."""
        return scan(self.key, self.world, self.poses[i], sensor=self.sensor, time=float(self.times[i]))

    def scans_in(self, threads: int) -> None:
        """All scans, in some threads."""
        with concurrent.futures.ThreadPoolExecutor(threads) as pool:
            list(pool.map(self.scan, range(len(self.poses))))


def measurements(name: str, sensor: Sensor, *, route: str) -> Iterator[tuple[Row, Callable[[], Row]]]:
    """The key of each row, and a function that measures its rest."""
    drive = functools.cache(lambda: TownDrive(route, BATCH, sensor))
    rays = {"sensor": name, "rays": [len(sensor.elevations_deg), sensor.azimuth_steps]}
    yield {"what": "scan", **rays}, lambda: _whole_scans(drive())
    for size in (1, BATCH):
        key = {"what": "cast", "batch": size, **rays}
        yield key, lambda size=size: _casts(drive(), size)
    for size in (1, BATCH):
        key = {"what": "rasterize", "batch": size, "points": POINTS}
        yield key, functools.partial(_rasterized, size)
    yield {"what": "density_bev on the host", "points": POINTS}, _densities


def _whole_scans(drive: TownDrive) -> Row:
    """Scans from the town to the host's memory: stages, and the rate in one and two threads.

    The cast is done twice to tell it from the returns, which follow it.
    """
    view = drive.view(0)
    turn = jax.block_until_ready(cast_turn(drive.key, view, sensor=drive.sensor))
    stages = {
        "cull": lambda: drive.view(0),
        "cast": lambda: jax.block_until_ready(first_surface(drive.key, view, sensor=drive.sensor)),
        "cast and returns": lambda: jax.block_until_ready(cast_turn(drive.key, view, sensor=drive.sensor)),
        "copy": lambda: returned_points(turn),
    }
    row = {f"{name}_s": median_seconds(job, repeats=REPEATS) for name, job in stages.items()}
    row["returns_s"] = row.pop("cast and returns_s") - row["cast_s"]
    one, two = (median_seconds(lambda n=n: drive.scans_in(n), repeats=REPEATS) for n in (1, 2))
    count = len(drive.poses)
    return {**row, "scans_per_second": count / one, "scans_per_second_in_2_threads": count / two}


def _casts(drive: TownDrive, batch: int) -> Row:
    """The device's part alone: the rays of this number of scans in one call, all surfaces on the device already."""
    keys = jax.random.split(jax.random.key(0), batch)
    views = [drive.view(i % len(drive.poses)) for i in range(batch)]
    stacked = jax.device_put(jax.tree.map(lambda *leaves: np.stack(leaves), *views))
    cast = jax.jit(jax.vmap(functools.partial(cast_turn, sensor=drive.sensor)))
    seconds = median_seconds(lambda: jax.block_until_ready(cast(keys, stacked)), repeats=REPEATS)
    return {"seconds": seconds, "scans_per_second": batch / seconds}


def _rasterized(batch: int) -> Row:
    clouds = jax.device_put(random_scans(batch, POINTS, grid=GRID)[0])
    seconds = median_seconds(lambda: jax.block_until_ready(rasterize(clouds, grid=GRID)), repeats=REPEATS)
    return {"seconds": seconds, "points_per_second": batch * POINTS / seconds}


def _densities() -> Row:
    """The density image, which numpy makes: no device takes part."""
    cloud = random_scans(POINTS, grid=GRID)[0]
    seconds = median_seconds(lambda: density_bev(cloud), repeats=REPEATS)
    return {"seconds": seconds, "points_per_second": POINTS / seconds}
