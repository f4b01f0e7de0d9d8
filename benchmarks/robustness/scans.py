"""Very many small scans, described in one go by a process whose time and memory are looked at."""

import dataclasses
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import TypeVar

import jax
import numpy as np

import sglpr_jax
from benchmarks.robustness.disturbed import report
from benchmarks.timing import resident_mb
from sglpr_jax.methods.registry import method_named
from sglpr_jax.sim.recording import simulate_recording
from sglpr_jax.sim.sensor import SENSORS

MOMENTS = 10
"""Rows of the table."""
CLOUDS = 100
"""Simulated scans of which the others are turned parts."""
SENSOR = dataclasses.replace(SENSORS["vlp16"], azimuth_steps=180)
T = TypeVar("T")


def scans(*, count: int = 100_000, points: int = 200, method: str = "solid") -> None:
    """Describe very many small scans in one go: seconds, and resident memory on the way.

    Args:
        count: number of scans.
        points: points of each scan.
        method: a handcrafted method that takes points, or `network`: the tiny preset, with weights as drawn.
    """
    seconds: dict[str, float] = {}

    def timed(what: str, job: Callable[[], T]) -> T:
        start = time.perf_counter()
        value = job()
        seconds[what] = time.perf_counter() - start
        return value

    rows: list[dict[str, float]] = []
    last = {"scans": 0, "seconds": time.perf_counter()}

    def watch(done: int) -> None:
        if done >= (len(rows) + 1) * count / MOMENTS and done != last["scans"]:
            seconds, scans = time.perf_counter() - last["seconds"], done - last["scans"]
            rows.append({"scans": done, "scans a second": scans / seconds, "MB resident": resident_mb()})
            last.update(scans=done, seconds=time.perf_counter())

    with tempfile.TemporaryDirectory() as name:
        folder, path = Path(name) / "scans", Path(name) / "all.npz"
        timed("write them", lambda: _write_scans(folder, count=count, points=points))
        recording = timed("open", lambda: sglpr_jax.open_recording(folder))
        tiny = method == "network"
        made = sglpr_jax.init(jax.random.key(0), preset="tiny") if tiny else method_named(method, None, recording)
        file = timed("embed", lambda: sglpr_jax.embed(made, recording, on_progress=watch))
        timed("save", lambda: file.save(path))
        assert len(timed("load", lambda: sglpr_jax.DescriptorFile.load(path))) == count
    parts = ", ".join(f"{value:.1f} s to {name}" for name, value in seconds.items())
    parts += f"; {file.descriptors.nbytes / 1e6:.0f} MB of descriptors"
    report(f"{count} scans of {points} points, {method}: {parts}", rows)


def _write_scans(folder: Path, *, count: int, points: int) -> None:
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
