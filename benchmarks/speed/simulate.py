"""How many scans a second the simulator makes, in one and in two threads, and where the time goes."""

import concurrent.futures
import dataclasses
import importlib.metadata
import os
import platform
import shlex
import sys
import time
from collections.abc import Callable
from typing import TypeVar

import jax
import numpy as np
from rich.console import Console
from rich.table import Table

from sglpr_jax.sim.drive import plan_path, poses_on, thinned
from sglpr_jax.sim.sensor import SENSORS, Sensor, cast_turn, first_surface, returned_points, scan, view_of
from sglpr_jax.sim.shapes import at_time
from sglpr_jax.sim.world import World, build_world

T = TypeVar("T")


def main(
    *, sensor: str = "hdl64e", azimuth_steps: int = 1800, seq: str = "00", scans: int = 100, repeats: int = 5
) -> None:
    """Time scans along a simulated drive.

    Args:
        sensor: one of the sensor presets.
        azimuth_steps: rays of a laser in one turn.
        seq: the drive.
        scans: scans of the drive, all of which are made in every repeat.
        repeats: how often everything is timed.
    """
    lidar = dataclasses.replace(SENSORS[sensor], azimuth_steps=azimuth_steps)
    drive = Along(seq, scans, lidar)
    drive.scan(0)  # compiles
    seconds = [drive.stages(i) for _ in range(repeats) for i in range(scans)]
    rates = {threads: [drive.rate(threads) for _ in range(repeats)] for threads in (1, 2)}
    _print_stages(f"one {sensor} scan of {len(lidar.elevations_deg)} x {azimuth_steps} rays", seconds)
    _print_rates(rates)
    _print_scene(drive)
    print(f"Command: {shlex.join(['python', *sys.argv])}")
    device = jax.devices()[0]
    print(f"Python {platform.python_version()}, jax {importlib.metadata.version('jax')}, {device.device_kind}")
    print(f"{os.cpu_count()} CPUs, load average {', '.join(f'{average:.1f}' for average in os.getloadavg())}")


class Along:
    """A drive through its town, and the sensor that makes it."""

    def __init__(self, seq: str, scans: int, sensor: Sensor):
        xy, yaw, self.times = thinned(plan_path(np.random.default_rng(0), seq, scans=scans), scans)
        self.world: World = build_world(0, xy, self.times)
        self.poses = poses_on(self.world.ground.relief, xy, yaw, height_m=sensor.height_m)
        self.sensor, self.key = sensor, jax.random.key(0)

    def scan(self, i: int) -> tuple[np.ndarray, np.ndarray]:
        return scan(self.key, self.world, self.poses[i], sensor=self.sensor, time=float(self.times[i]))

    def rate(self, threads: int) -> float:
        """Scans per second."""
        start = time.perf_counter()
        with concurrent.futures.ThreadPoolExecutor(threads) as pool:
            list(pool.map(self.scan, range(len(self.poses))))
        return len(self.poses) / (time.perf_counter() - start)

    def stages(self, i: int) -> dict[str, float]:
        """Seconds of each stage of scan `i`; the cast is done twice to tell it from the returns, which follow it."""
        view, cull = timed(lambda: view_of(self.world, self.poses[i], sensor=self.sensor, time=float(self.times[i])))
        _, cast = timed(lambda: jax.block_until_ready(first_surface(self.key, view, sensor=self.sensor)))
        turn, both = timed(lambda: jax.block_until_ready(cast_turn(self.key, view, sensor=self.sensor)))
        _, copy = timed(lambda: returned_points(turn))
        return {"cull": cull, "cast": cast, "returns": both - cast, "copy": copy}

    def shapes_in_range(self, i: int) -> list[int]:
        """How many boxes, cylinders and ellipsoids are there and near enough to be hit."""
        where, reach = self.poses[i][:3, 3], self.sensor.max_range_m
        return [len(at_time(kind, float(self.times[i]), where, reach_m=reach).label) for kind in self.world.scene]


def timed(job: Callable[[], T]) -> tuple[T, float]:
    """What `job` returns, and its seconds."""
    start = time.perf_counter()
    value = job()
    return value, time.perf_counter() - start


def _print_stages(title: str, seconds: list[dict[str, float]]) -> None:
    medians = {stage: float(np.median([each[stage] for each in seconds])) for stage in seconds[0]}
    print(f"{title}, medians:")
    table = Table("stage", "ms", "share")
    for stage, median in medians.items():
        table.add_row(stage, f"{1e3 * median:.2f}", f"{median / sum(medians.values()):.0%}")
    Console().print(table)


def _print_rates(rates: dict[int, list[float]]) -> None:
    for threads, measured in rates.items():
        low, middle, high = np.quantile(measured, (0, 0.5, 1))
        print(f"{threads} thread(s): {middle:.1f} scans per second ({low:.1f} to {high:.1f})")


def _print_scene(drive: Along) -> None:
    some = range(0, len(drive.poses), max(1, len(drive.poses) // 20))
    counts = np.mean([drive.shapes_in_range(i) for i in some], axis=0)
    points = np.mean([len(drive.scan(i)[0]) for i in some])
    print("Shapes in range: {:.0f} boxes, {:.0f} cylinders, {:.0f} ellipsoids".format(*counts))
    print(f"Points of a scan: {points:,.0f}")


if __name__ == "__main__":
    import tyro  # here, for gpu.py uses the rest of this file where there is no tyro

    tyro.cli(main)
