"""How fast this device makes scans of a simulated town, and images of clouds: one row each."""

import dataclasses
import functools
import time
from collections.abc import Callable, Iterator
from typing import Any

import jax
import numpy as np

from benchmarks.gpu.kept_rows import Row
from benchmarks.speed.inputs import random_scans
from benchmarks.speed.simulate import Along
from sglpr_jax.bev import rasterize
from sglpr_jax.data.density_image import density_bev
from sglpr_jax.grid import Grid
from sglpr_jax.sim.sensor import SENSORS, Sensor, cast_turn, view_of

GRID = Grid(height=224, width=224)
"""The paper's, onto which clouds are rasterised."""


@dataclasses.dataclass(frozen=True)
class RateConfig:
    """What is timed, and how often."""

    sensor: str
    azimuth_steps: int | None
    """None: as many as the real sensor's."""
    route: str
    batch: int
    """Scans and clouds in one call, beside one alone."""
    points: int
    """Of a cloud."""
    repeats: int


def lidar(sensor: str, azimuth_steps: int | None) -> Sensor:
    """The sensor of that name, with so many firings a turn. Raises ValueError for one that is not known."""
    if sensor not in SENSORS:
        raise ValueError(f"expected a sensor among {', '.join(SENSORS)}, found {sensor!r}")
    known = SENSORS[sensor]
    return known if azimuth_steps is None else dataclasses.replace(known, azimuth_steps=azimuth_steps)


def measurements(config: RateConfig) -> Iterator[tuple[Row, Callable[[], Row]]]:
    """Of each row its key, and what measures the rest of it."""
    sensor, batches, repeats = lidar(config.sensor, config.azimuth_steps), (1, config.batch), config.repeats
    drive = functools.cache(lambda: Along(config.route, max(config.batch, 2), sensor))
    scan = {"sensor": config.sensor, "rays": [len(sensor.elevations_deg), sensor.azimuth_steps]}
    yield {"what": "scan", **scan}, lambda: _whole_scans(drive(), repeats)
    for batch in batches:
        yield {"what": "cast", "batch": batch, **scan}, functools.partial(_casts, drive, batch, repeats)
    for batch in batches:
        key = {"what": "rasterize", "batch": batch, "points": config.points}
        yield key, functools.partial(_rasterized, batch, config.points, repeats)
    key = {"what": "density_bev on the host", "points": config.points}
    yield key, functools.partial(_densities, config.points, repeats)


def _whole_scans(drive: Along, repeats: int) -> Row:
    """Scans from the town to the host's memory: stages, and the rate in one and two threads."""
    drive.stages(0)  # compiles
    seconds = [drive.stages(i) for _ in range(repeats) for i in range(len(drive.poses))]
    rates = {threads: float(np.median([drive.rate(threads) for _ in range(repeats)])) for threads in (1, 2)}
    stages = {f"{name}_s": float(np.median([each[name] for each in seconds])) for name in seconds[0]}
    return {**stages, "scans_per_second": rates[1], "scans_per_second_in_2_threads": rates[2]}


def _casts(drive: Callable[[], Along], batch: int, repeats: int) -> Row:
    """The device's part alone: the rays of so many scans in one call, all they may meet on the device already."""
    along, keys = drive(), jax.random.split(jax.random.key(0), batch)
    views = [
        view_of(along.world, along.poses[i], sensor=along.sensor, time=float(along.times[i])) for i in range(batch)
    ]
    stacked = jax.device_put(jax.tree.map(lambda *leaves: np.stack(leaves), *views))
    cast = jax.jit(jax.vmap(functools.partial(cast_turn, sensor=along.sensor)))
    seconds = _median_seconds(lambda: cast(keys, stacked), repeats)
    return {"seconds": seconds, "scans_per_second": batch / seconds}


def _rasterized(batch: int, points: int, repeats: int) -> Row:
    clouds = jax.device_put(random_scans(batch, points, grid=GRID)[0])
    seconds = _median_seconds(lambda: rasterize(clouds, grid=GRID), repeats)
    return {"seconds": seconds, "points_per_second": batch * points / seconds}


def _densities(points: int, repeats: int) -> Row:
    """The density image, which numpy makes: no device takes part."""
    cloud = random_scans(points, grid=GRID)[0]
    seconds = _median_seconds(lambda: density_bev(cloud), repeats)
    return {"seconds": seconds, "points_per_second": points / seconds}


def _median_seconds(job: Callable[[], Any], repeats: int) -> float:
    """Of a job's runs, its results waited for; one run before them compiles."""
    jax.block_until_ready(job())
    seconds = []
    for _ in range(repeats):
        start = time.perf_counter()
        jax.block_until_ready(job())
        seconds.append(time.perf_counter() - start)
    return float(np.median(seconds))
