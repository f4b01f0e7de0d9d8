"""The simulator on this device: its rates first, then a dataset of towns that later calls complete."""

import dataclasses
import time
from collections.abc import Callable
from pathlib import Path

from benchmarks.gpu.kept_rows import KeptRows, Row
from benchmarks.gpu.simulator_rates import RateConfig, lidar, measurements
from benchmarks.speed.throughput import about
from sglpr_jax.sim.dataset import Simulated, simulate
from sglpr_jax.sim.layouts import LAYOUTS

FILE = "simulate.json"


@dataclasses.dataclass(frozen=True)
class TownsConfig:
    """The dataset that is written; the same at every call."""

    out: Path
    routes: tuple[str, ...]
    scans: int
    """Of each route."""
    layout: str
    """`images`, `varied` or `scans`, see `LAYOUTS`."""
    sensor: str
    azimuth_steps: int | None
    """None: as many as the real sensor's."""
    seed: int

    @property
    def is_whole(self) -> bool:
        """Whether all of it is on the disk."""
        sensor = lidar(self.sensor, self.azimuth_steps)
        missing = Simulated(self.out, self.routes, self.scans, self.layout, sensor).missing
        return not missing and self.scans_there == self.scans * len(self.routes)

    @property
    def scans_there(self) -> int:
        """How many scans are on the disk."""
        files_of = LAYOUTS[self.layout].files_of_scan
        scans = ((name, f"{i:06d}") for name in self.routes for i in range(self.scans))
        return sum(all(file.exists() for file in files_of(self.out, name, id)) for name, id in scans)


class OutOfTime(Exception):
    """The time for a dataset is over; it can be gone on with."""


def simulate_towns(towns: TownsConfig, rates: RateConfig, results: Path, stopped: Callable[[], bool]) -> bool:
    """Measure what has not been yet, then write what is missing of the dataset; whether all is done.

    Rows go to simulate.json in `results`. `stopped` is asked between them, and after every scan. Raises as `simulate`,
    and ValueError for a sensor that is not known.
    """
    rows, device = KeptRows(results / FILE, about=about()), {"device": about()["device"]}
    for key, measure in measurements(rates):
        if stopped():
            return False
        rows.add(key | device, measure)
    if not towns.is_whole and not stopped():
        calls = [row for row in rows.rows if row["what"] == "dataset"]
        key = {"what": "dataset", "call": len(calls) + 1, "out": str(towns.out), "layout": towns.layout}
        rows.add(key | device, lambda: _write(towns, stopped))
    return towns.is_whole


def _write(towns: TownsConfig, stopped: Callable[[], bool]) -> Row:
    """Write scans until all are there or the time is over; how many a second, building and compiling included."""

    def look(done: int) -> None:
        if stopped():
            raise OutOfTime

    options = {name: getattr(towns, name) for name in ("routes", "scans", "sensor", "azimuth_steps", "seed")}
    before, start, finished = towns.scans_there, time.perf_counter(), False
    try:
        images, vary = towns.layout != "scans", towns.layout == "varied"
        simulate(towns.out, images=images, vary=vary, on_progress=look, **options)
        finished = True
    except OutOfTime:
        pass
    seconds, made = time.perf_counter() - start, towns.scans_there - before
    return {"scans": made, "seconds": seconds, "scans_per_second": made / seconds, "finished": finished}
