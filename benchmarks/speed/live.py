"""Latency of bin/live from the publication of a scan to its loops, between processes, with dropped scans and memory.

A process publishes a simulated drive at a fixed rate, there and back. bin/live runs in another process. The latency of
a scan is the time from before it is published to the line of bin/live that reports it or its loop.
"""

import functools
import json
import multiprocessing
import os
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from benchmarks.table import Table
from benchmarks.timing import resident_mb
from sglpr_jax.live.data_types import Reports
from sglpr_jax.live.ros_encoding import CLOUD, TRANSFORMS, encode, header, transform_message
from sglpr_jax.live.ros_topics import Transport, domain_of
from sglpr_jax.models.shipped import DEFAULT_WEIGHTS
from sglpr_jax.se3 import quaternions
from sglpr_jax.sim.recording import simulate_recording
from sglpr_jax.sim.sensor import SENSORS


class FolderPublisher:
    """Writes scans, which are renamed when they are whole, and a growing tum file."""

    def __init__(self, where: str):
        self._folder = Path(where)
        self._folder.mkdir(exist_ok=True)
        self._poses = self._folder.parent / "poses.tum"
        self._poses.touch()
        self.flags = ("--poses", str(self._poses))

    def put(self, points: np.ndarray, world_from_lidar: np.ndarray, stamp: float) -> None:
        """Publish a scan with its odometry at a time in seconds since 1970."""
        numbers = [stamp, *world_from_lidar[:3, 3], *quaternions(world_from_lidar[None])[0]]
        with self._poses.open("a") as file:
            file.write(" ".join(f"{number:.9f}" for number in numbers) + "\n")
        hidden = self._folder / f".{stamp:.6f}.bin"
        np.pad(points, ((0, 0), (0, 1))).astype("<f4").tofile(hidden)
        hidden.rename(self._folder / f"{stamp:.6f}.bin")


class RosPublisher:
    """Publishes clouds with 16 bytes a point, as common drivers do, and the odometry as a transform before each."""

    flags = ("--topic", "/points", "--odometry-topic", "/odometry")

    def __init__(self, connect: Callable[[str], Transport], where: str):
        """The connection opens with the first scan. Scans before the subscription finds it are lost."""
        self._connect = functools.partial(connect, where)

    def put(self, points: np.ndarray, world_from_lidar: np.ndarray, stamp: float) -> None:
        """Publish a scan with its odometry at a time in seconds since 1970."""
        clouds, poses = self.topics
        poses(transform_message(world_from_lidar, time=stamp, frame="odom", child="lidar"))
        clouds(encode(CLOUD, cloud_fields(points, stamp)))

    @functools.cached_property
    def topics(self) -> tuple[Callable[[bytes], None], Callable[[bytes], None]]:
        """Functions that publish a cloud and transforms."""
        wire = self.wire
        clouds = wire.advertise("/points", CLOUD, depth=1, latched=False)
        return clouds, wire.advertise("/odometry", TRANSFORMS, depth=100, latched=False)

    @functools.cached_property
    def wire(self) -> Transport:
        """The connection."""
        return self._connect()


def cloud_fields(points: np.ndarray, stamp: float) -> dict[str, Any]:
    """Fields of a PointCloud2 with x, y and z."""
    padded = np.pad(points.astype(np.float32), ((0, 0), (0, 1)))
    return {
        "header": header(stamp, "lidar"),
        "height": 1,
        "width": len(points),
        "fields": [{"name": name, "offset": 4 * at, "datatype": 7, "count": 1} for at, name in enumerate("xyz")],
        "point_step": 16,
        "row_step": padded.nbytes,
        "data": padded.view(np.uint8).reshape(-1),
        "is_dense": True,
    }


def _dds(where: str) -> Transport:
    """Connection in a domain."""
    from sglpr_jax.live.dds import DdsTransport

    return DdsTransport(domain_of(where, source="dds"), Reports())


def _zenoh(endpoint: str) -> Transport:
    """Connection that listens at an endpoint, such as tcp/127.0.0.1:7450."""
    from sglpr_jax.live.zenoh import ZenohTransport

    config = {"listen": {"endpoints": [endpoint]}, "scouting": {"multicast": {"enabled": False}}}
    with tempfile.NamedTemporaryFile("w", suffix=".json5") as file:
        json.dump(config, file)
        file.flush()
        os.environ["ZENOH_SESSION_CONFIG_URI"] = file.name
        return ZenohTransport("", domain_of("", source="zenoh"), Reports())


PUBLISHERS: dict[str, Callable[[str], Any]] = {
    "folder": FolderPublisher,
    "dds": functools.partial(RosPublisher, _dds),
    "zenoh": functools.partial(RosPublisher, _zenoh),
}
"""By the name of the source."""


def live(
    *,
    source: str = "folder",
    rates: tuple[float, ...] = (10.0, 20.0),
    seconds: float = 60.0,
    warm_s: float = 10.0,
    scans: int = 240,
    weights: str = DEFAULT_WEIGHTS,
) -> None:
    """Measure the latency of bin/live for a source, dropped scans and memory. Prints a row for each rate.

    Args:
        source: source of bin/live, without `:WHERE` for a folder, which is temporary.
        rates: scans a second.
        seconds: duration at each rate, without the start.
        warm_s: time before memory is measured for the first time.
        scans: scans of the simulated drive.
        weights: weights of bin/live.
    """
    table = None
    for rate in rates:
        row = _measured(source, rate, seconds, warm_s, scans, weights)
        table = table or Table(*row)
        table.add(*(f"{value:.4g}" for value in row.values()))


def _measured(source: str, rate: float, seconds: float, warm_s: float, scans: int, weights: str) -> dict[str, float]:
    """Run both processes at one rate. Returns a row of the table."""
    count = int(rate * (seconds + warm_s))
    with tempfile.TemporaryDirectory() as place:
        folder = Path(place)
        name, _, where = source.partition(":")
        where = str(folder / "scans") if name == "folder" else where
        begin = time.monotonic()
        node = LiveProcess(name, where, folder, weights)
        node.wait_until(lambda: "ready:" in node.log.read_text())
        start_s = time.monotonic() - begin
        context = multiprocessing.get_context("spawn")
        process = context.Process(target=_publish, args=(name, where, rate, count, scans))
        process.start()
        node.wait_until(lambda: node.frames)
        time.sleep(warm_s)
        before = node.memory()
        process.join(seconds / 2)
        middle = node.memory()
        process.join()
        time.sleep(1.0)
        after = node.memory()
        node.close()
        memory = {
            "resident [MB]": after.resident_mb,
            "grown [MB]": after.resident_mb - before.resident_mb,
            "in the second half [MB]": after.resident_mb - middle.resident_mb,
            "map grown [MB]": after.map_mb - before.map_mb,
            "places": after.places,
            "kB a place": 1e3 * (after.map_mb - before.map_mb) / max(after.places - before.places, 1),
        }
        return {"Hz": rate, "start [s]": start_s, **node.row(count), **memory}


def _publish(name: str, where: str, rate: float, count: int, scans: int) -> None:
    """Publish scans at a rate, in a process of its own."""
    publisher = PUBLISHERS[name](where)
    for points, pose in scans_at(rate, count, scans):
        publisher.put(points, pose, time.time())


def scans_at(rate: float, count: int, scans: int) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Yield `count` scans of a drive there and back, and their poses, at a rate."""
    recording = simulate_recording("08", scans=scans, sensor=SENSORS["vlp16"], seed=3)
    clouds = [recording.points(i) for i in range(len(recording))]
    poses = recording.poses.world_from_lidar
    there_and_back = [*range(len(recording)), *range(len(recording) - 2, 0, -1)]
    begin = time.monotonic()
    for number in range(count):
        time.sleep(max(0.0, begin + number / rate - time.monotonic()))
        row = there_and_back[number % len(there_and_back)]
        yield clouds[row], poses[row]


class Memory(NamedTuple):
    """Memory of a node in 10^6 bytes, with its own count of the map's bytes, and the places of the map."""

    resident_mb: float
    map_mb: float
    places: int


class LiveProcess:
    """A process of bin/live, whose lines are read as they come."""

    def __init__(self, source: str, where: str, folder: Path, weights: str):
        """Start bin/live for a source, with its map and its stderr in a folder."""
        self.log, self.frames, self.loops = folder / "errors.txt", list[dict](), list[dict]()
        """File of stderr, and the lines of scans and of loops."""
        self.latencies_s: dict[str, list[float]] = {"frame": [], "edge": []}
        """Latency of each scan, and of each scan with loops, to its last loop."""
        flags = [f"{source}:{where}" if where else source, "--out", folder / "map", "--weights", weights]
        command = [sys.executable, "-m", "sglpr_jax.cli", "live", *flags, *PUBLISHERS[source](where).flags]
        with self.log.open("w") as errors:
            self._node = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=errors, text=True)
        self._thread = threading.Thread(target=self._read, daemon=True)
        self._thread.start()

    def close(self) -> int:
        """End the node by SIGTERM, if it runs. Returns its exit status."""
        self._node.send_signal(signal.SIGTERM)  # nothing for a process that has ended
        status = self._node.wait()
        self._thread.join()
        assert self._node.stdout is not None
        self._node.stdout.close()
        return status

    def wait_until(self, condition: Callable[[], Any]) -> None:
        """Wait for a condition while the node runs."""
        while not condition():
            if self._node.poll() is not None:
                raise RuntimeError(f"bin/live ended with {self._node.returncode}")
            time.sleep(0.05)

    @property
    def is_alive(self) -> bool:
        """Whether the node runs."""
        return self._node.poll() is None

    def memory(self) -> Memory:
        """Memory of the node now, and the map at its last line."""
        last = self.frames[-1]
        return Memory(resident_mb(self._node.pid), last["nbytes"] / 1e6, last["places"])

    def row(self, published: int) -> dict[str, float]:
        """Numbers of the table."""
        row = {"published": published, "taken": len(self.frames), "dropped": self.frames[-1]["dropped"]}
        for what, values in self.latencies_s.items():
            for share in (50, 99):
                row[f"{what} {share} % [ms]"] = 1000 * float(np.percentile(values, share)) if values else np.nan
        return {**row, "loops": len(self.latencies_s["edge"])}

    def _read(self) -> None:
        """Reads all lines. The lines of a scan's loops come before the line of the scan."""
        assert self._node.stdout is not None
        last_loop_time = None
        for line in self._node.stdout:
            now, message = time.time(), json.loads(line)
            if message["type"] == "loop":
                last_loop_time = now
                self.loops.append(message)
                continue
            self.frames.append(message)
            self.latencies_s["frame"].append(now - message["time"])
            if last_loop_time is not None:
                self.latencies_s["edge"].append(last_loop_time - message["time"])
            last_loop_time = None
