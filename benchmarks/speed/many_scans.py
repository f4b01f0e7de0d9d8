"""Very many small scans, described in one go by a process whose time and memory are looked at."""

import dataclasses
import os
import time
from pathlib import Path

import jax
import numpy as np

from sglpr_jax.models.params import Params
from sglpr_jax.models.sglpr import init
from sglpr_jax.sim.recording import simulate_recording
from sglpr_jax.sim.sensor import SENSORS

CLOUDS = 100
"""Simulated scans of which the others are turned parts."""
SENSOR = dataclasses.replace(SENSORS["vlp16"], azimuth_steps=180)


class Watch:
    """Told how many scans are done, notes time and memory at so many moments."""

    def __init__(self, count: int, moments: int):
        self.rows: list[dict[str, float]] = []
        """Scans done, seconds since the start, scans per second since the row before, MB resident."""
        self._every, self._start = count / moments, time.perf_counter()

    def __call__(self, done: int) -> None:
        last = self.rows[-1] if self.rows else {"scans": 0, "seconds": 0.0}
        before, then = last["scans"], last["seconds"]
        if done < (len(self.rows) + 1) * self._every or done == before:
            return
        now = time.perf_counter() - self._start
        rate = (done - before) / (now - then)
        self.rows.append({"scans": done, "seconds": now, "scans a second": rate, "MB resident": resident_mb()})


def resident_mb() -> float:
    """Memory of this process."""
    return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGESIZE") / 1e6


def write_scans(folder: Path, *, count: int, points: int) -> None:
    """Write scans of so many points: parts of simulated ones, each turned by an angle of its own."""
    folder.mkdir()
    rng = np.random.default_rng(0)
    drive = simulate_recording("08", scans=CLOUDS, sensor=SENSOR, seed=0)
    clouds = [drive.record(i, labels=False).points for i in range(CLOUDS)]
    for i in range(count):
        x, y, z = rng.choice(clouds[i % CLOUDS], size=points).T
        angle = rng.uniform(0, 2 * np.pi)
        turned = (np.cos(angle) * x - np.sin(angle) * y, np.sin(angle) * x + np.cos(angle) * y)
        scan = np.stack([*turned, z, np.zeros(points)], axis=1).astype("<f4")
        (folder / f"{i:06d}.bin").write_bytes(scan.tobytes())


def tiny_network() -> Params:
    """The model of the tiny preset, as drawn."""
    return init(jax.random.key(0), preset="tiny")
