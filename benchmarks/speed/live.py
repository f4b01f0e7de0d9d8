"""Latency of bin/live from the publication of a scan to its loops, between processes, with dropped scans and memory.

A process publishes a simulated drive at a fixed rate, there and back again and again. bin/live runs in another process.
The latency of a scan is the time from before it is published to the line of bin/live that reports it or its loop.
"""

import dataclasses
import importlib
import json
import multiprocessing
import os
import signal
import subprocess
import sys
import tempfile
import threading
import time
from pathlib import Path
from typing import Protocol

import numpy as np
import tyro

from sglpr_jax.models.shipped import DEFAULT_WEIGHTS
from sglpr_jax.sim.recording import simulate_recording
from sglpr_jax.sim.sensor import SENSORS


class Publisher(Protocol):
    """Publishes scans for a source. The function `publisher(where)` of `benchmarks.speed.live_SOURCE` makes one."""

    flags: tuple[str, ...]
    """Flags of bin/live for this source, beside its name."""

    def put(self, points: np.ndarray, world_from_lidar: np.ndarray, stamp: float) -> None:
        """Publish a scan with its odometry at a time in seconds since 1970."""
        ...


@dataclasses.dataclass(frozen=True)
class Options:
    """Flags of the program."""

    source: str = "folder"
    """Source of bin/live, without `:WHERE` for a folder, which is temporary."""
    rates: tuple[float, ...] = (10.0, 20.0)
    """Scans a second."""
    seconds: float = 60.0
    """Duration at each rate, without the start."""
    warm_s: float = 10.0
    """Time before memory is measured for the first time."""
    scans: int = 240
    """Scans of the simulated drive."""
    sensor: str = "vlp16"
    weights: str = DEFAULT_WEIGHTS
    flags: tuple[str, ...] = ()
    """More flags of bin/live, such as `max-places=500`."""


def publisher_of(name: str, where: str) -> Publisher:
    """Publisher for a source."""
    return importlib.import_module(f"benchmarks.speed.live_{name}").publisher(where)


def measured(options: Options, rate: float) -> dict[str, float]:
    """Run both processes at one rate. Returns a row of the table."""
    with tempfile.TemporaryDirectory() as place:
        folder = Path(place)
        name, _, where = options.source.partition(":")
        where = str(folder / "scans") if name == "folder" else where
        text = f"{name}:{where}" if where else name
        publisher = publisher_of(name, where)
        more = [part for flag in options.flags for part in f"--{flag}".split("=", 1)]
        command = ["-m", "sglpr_jax.cli.live", text, "--out", str(folder / "map"), "--weights", options.weights]
        with (folder / "errors.txt").open("w") as errors:
            node = subprocess.Popen(
                [sys.executable, *command, *publisher.flags, *more], stdout=subprocess.PIPE, stderr=errors, text=True
            )
        results = Results(node)
        ready = wait_for(folder / "errors.txt", "ready:", node)
        context = multiprocessing.get_context("spawn")
        process = context.Process(target=publish, args=(name, where, rate, options))
        process.start()
        wait_until(lambda: results.frames, node)
        time.sleep(options.warm_s)
        before = results.memory()
        process.join()
        time.sleep(1.0)
        after = results.memory()
        node.send_signal(signal.SIGTERM)
        results.close()
        published = int(rate * (options.seconds + options.warm_s))
        return {"Hz": rate, "start [s]": ready, **results.row(published), **growth(before, after)}


def publish(name: str, where: str, rate: float, options: Options) -> None:
    """Publish scans at a rate, in a process of its own."""
    drive = simulate_recording("08", scans=options.scans, sensor=SENSORS[options.sensor], seed=3)
    clouds = [drive.points(i) for i in range(len(drive))]
    poses = drive.poses.world_from_lidar
    there_and_back = [*range(len(drive)), *range(len(drive) - 2, 0, -1)]
    publisher = publisher_of(name, where)
    begin = time.monotonic()
    for count in range(int(rate * (options.seconds + options.warm_s))):
        time.sleep(max(0.0, begin + count / rate - time.monotonic()))
        row = there_and_back[count % len(there_and_back)]
        publisher.put(clouds[row], poses[row], time.time())


class Results:
    """Reads the lines of bin/live as they come."""

    def __init__(self, node: subprocess.Popen):
        self.frames: list[dict] = []
        self.of_frames: list[float] = []
        self.of_loops: list[float] = []
        """Latencies in seconds: of each scan, and of each scan with loops, to its last loop."""
        self._node = node
        self._thread = threading.Thread(target=self._read, daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Wait for the end of the node."""
        self._node.wait()
        self._thread.join()
        assert self._node.stdout is not None
        self._node.stdout.close()

    def memory(self) -> tuple[float, float]:
        """Resident memory of the node in MB, and its count of the map's bytes in MB."""
        pages = int(Path(f"/proc/{self._node.pid}/statm").read_text().split()[1])
        return pages * os.sysconf("SC_PAGESIZE") / 1e6, self.frames[-1]["nbytes"] / 1e6

    def row(self, published: int) -> dict[str, float]:
        """Numbers of the table."""
        row = {"published": published, "taken": len(self.frames), "dropped": self.frames[-1]["dropped"]}
        for what, values in (("frame", self.of_frames), ("edge", self.of_loops)):
            for share in (50, 99):
                row[f"{what} {share} % [ms]"] = 1000 * float(np.percentile(values, share)) if values else np.nan
        return {**row, "loops": len(self.of_loops)}

    def _read(self) -> None:
        """The loops of a scan come before its own line."""
        assert self._node.stdout is not None
        looped = None
        for line in self._node.stdout:
            now, value = time.time(), json.loads(line)
            if value["type"] == "loop":
                looped = now
                continue
            self.frames.append(value)
            self.of_frames.append(now - value["time"])
            if looped is not None:
                self.of_loops.append(looped - value["time"])
            looped = None


def growth(before: tuple[float, float], after: tuple[float, float]) -> dict[str, float]:
    """Memory at the end and its growth, beside that of the map."""
    return {"resident [MB]": after[0], "grown [MB]": after[0] - before[0], "map grown [MB]": after[1] - before[1]}


def wait_for(path: Path, text: str, node: subprocess.Popen) -> float:
    """Seconds until a file contains a text."""
    begin = time.monotonic()
    wait_until(lambda: text in path.read_text(), node)
    return time.monotonic() - begin


def wait_until(condition, node: subprocess.Popen) -> None:
    """Wait for a condition while the node runs."""
    while not condition():
        if node.poll() is not None:
            raise RuntimeError(f"bin/live ended with {node.returncode}")
        time.sleep(0.05)


def main(options: Options) -> None:
    """Print a row for each rate."""
    for at, rate in enumerate(options.rates):
        row = measured(options, rate)
        if not at:
            print("| " + " | ".join(row) + " |\n|" + "---|" * len(row))
        print("| " + " | ".join(f"{value:.4g}" for value in row.values()) + " |", flush=True)


if __name__ == "__main__":
    main(tyro.cli(Options, description=__doc__))
