"""Latency of `bin/live` between processes: from publishing a scan to its loop edges, over DDS or zenoh.

    python -m benchmarks.speed.live_ros my_scans --wire dds --hz 10 --seconds 600

This process publishes the scans and poses of a recording, to and fro, and receives the edges and transforms. Stamps are
the times of publishing. Points have 16 bytes, as those of common drivers.
"""

import json
import os
import socket
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
import tyro
from rich.console import Console
from rich.table import Table

import sglpr_jax
from sglpr_jax.live.dds_wire import DdsWire
from sglpr_jax.live.report import Reports
from sglpr_jax.live.ros_messages import CLOUD, EDGE, TRANSFORMS, encode, transform_message, typestore
from sglpr_jax.live.ros_wire import Received, Wire
from sglpr_jax.live.zenoh_wire import ZenohWire
from sglpr_jax.loops.odometry import read_odometry

STAMP = slice(4, 12)
"""Bytes of the stamp in a message that begins with a header."""
DOMAIN = 77
"""DDS domain of the benchmark."""
ODOMETRY = "/odometry"
"""Topic of the poses, of the type of tf."""
WARM_S = 20.0
"""Time after which the memory is measured first, in seconds."""
CALM_S = 2.0
"""Time in which subscriptions find each other, and in which the last results arrive, in seconds."""


class Message(NamedTuple):
    """A scan and its pose, encoded."""

    cloud: bytes
    world_from_lidar: np.ndarray


class Latencies:
    """Times from publishing to results, in seconds."""

    def __init__(self):
        self.frames: list[float] = []
        self.loops: list[float] = []
        self.inside: list[float] = []

    def frame(self, message: Received) -> None:
        """Take a transform, which is published after each scan with the stamp of the scan."""
        self.frames.append(time.time() - _stamp(message.cdr[8:16]))

    def loop(self, message: Received) -> None:
        """Take an edge. Its stamp is that of the query, which may be a scan before the latest."""
        self.loops.append(time.time() - _stamp(message.cdr[STAMP]))


def main(
    data: tyro.conf.Positional[Path],
    *,
    flags: tuple[str, ...] = (),
    wire: Literal["dds", "zenoh"] = "dds",
    hz: float = 10.0,
    seconds: float = 60.0,
) -> None:
    """Print latencies, lost scans and memory.

    Args:
        data: recording with poses that are odometry.
        flags: more flags of `bin/live`, such as `--flags=--max-places --flags=1000`.
        wire: connection between the processes.
        hz: scans a second.
        seconds: time for which scans are published.
    """
    messages = encoded(data)
    endpoint = str(DOMAIN) if wire == "dds" else _free_endpoint()
    connection, found = opened(wire, endpoint), Latencies()
    for topic, kind, receive in (("/tf", TRANSFORMS, found.frame), ("/sglpr/loops", EDGE, found.loop)):
        connection.subscribe(topic, [kind], receive, depth=100, reliable=True, latched=False)
    with tempfile.TemporaryDirectory() as folder:
        process = started(f"{wire}:{endpoint}", Path(folder), flags)
        memory: list[float] = []
        threading.Timer(WARM_S, lambda: memory.append(_resident_mb(process.pid))).start()
        sent = publish(connection, messages, hz=hz, seconds=seconds)
        time.sleep(CALM_S)
        memory.append(_resident_mb(process.pid))
        process.terminate()
        process.wait()
        results = map(json.loads, (Path(folder) / "results").read_text().splitlines())
        statuses = [one for one in results if one["type"] == "frame"]
    connection.close()
    found.inside = [one["latency_s"] for one in statuses]
    print(
        f"{wire}, {hz:g} Hz, {len(messages[0].cloud) / 1e6:.2f} MB a scan, load of the computer {os.getloadavg()[0]:.1f}"
    )
    show(sent, statuses[-1]["dropped"], found, memory)


def encoded(data: Path) -> list[Message]:
    """Scans and poses of a recording as messages. Poses of a layout without rotations are in the axes of KITTI."""
    recording = sglpr_jax.open_recording(data)
    poses = recording.world_from_lidar
    if poses is None:
        poses = read_odometry(data / str(recording.pose_source), format="kitti")
    return [Message(_cloud(recording.points(i)), poses[i]) for i in range(len(recording))]


def _cloud(points: np.ndarray) -> bytes:
    types = typestore().types
    padded = np.zeros((len(points), 4), np.float32)
    padded[:, :3] = points
    stamp = types["builtin_interfaces/msg/Time"](sec=0, nanosec=0)
    field = types["sensor_msgs/msg/PointField"]
    cloud = types[CLOUD](
        header=types["std_msgs/msg/Header"](stamp=stamp, frame_id="lidar"),
        height=1,
        width=len(points),
        fields=[field(name=name, offset=4 * at, datatype=7, count=1) for at, name in enumerate("xyz")],
        is_bigendian=False,
        point_step=16,
        row_step=padded.nbytes,
        data=padded.view(np.uint8).reshape(-1),
        is_dense=True,
    )
    return encode(cloud)


def opened(wire: str, endpoint: str) -> Wire:
    """Open the connection of this process. That of zenoh listens at the endpoint."""
    if wire == "dds":
        return DdsWire(int(endpoint), Reports())
    with tempfile.NamedTemporaryFile("w", suffix=".json5") as file:
        json.dump({"listen": {"endpoints": [endpoint]}, "scouting": {"multicast": {"enabled": False}}}, file)
        file.flush()
        os.environ["ZENOH_SESSION_CONFIG_URI"] = file.name
        return ZenohWire("", 0, Reports())


def started(where: str, folder: Path, flags: tuple[str, ...]) -> subprocess.Popen:
    """Start `bin/live` and wait until it is ready."""
    topics = ("--topic", "/points", "--odometry-topic", ODOMETRY)
    sinks = ("--sinks", where, f"json:{folder / 'results'}", "--out", str(folder / "map"))
    command = (sys.executable, "-m", "sglpr_jax.cli.live", where, *topics, *sinks, *flags)
    process = subprocess.Popen(command, stderr=subprocess.PIPE, text=True)
    assert process.stderr is not None
    ready = next((line for line in process.stderr if not print(line, end="") and line.startswith("ready")), None)
    if ready is None:
        raise SystemExit(f"expected bin/live to become ready, found exit status {process.wait()}")
    threading.Thread(target=_repeat, args=(process.stderr,), daemon=True).start()
    time.sleep(CALM_S)
    return process


def _repeat(lines: Any) -> None:
    for line in lines:
        print(line, end="", flush=True)


def publish(connection: Wire, messages: list[Message], *, hz: float, seconds: float) -> int:
    """Publish scans at a rate, each after its pose. Returns their number."""
    clouds = connection.advertise("/points", CLOUD, depth=1, latched=False)
    poses = connection.advertise(ODOMETRY, TRANSFORMS, depth=100, latched=False)
    time.sleep(CALM_S)
    start, number = time.monotonic(), round(hz * seconds)
    for step in range(number):
        time.sleep(max(0.0, start + step / hz - time.monotonic()))
        at = step % (2 * len(messages))
        _publish(messages[min(at, 2 * len(messages) - 1 - at)], clouds, poses)
    return number


def _publish(message: Message, clouds: Callable[[bytes], None], poses: Callable[[bytes], None]) -> None:
    now = time.time()
    poses(encode(transform_message(message.world_from_lidar, time=now, frame="odom", child="lidar")))
    stamp = np.array(divmod(round(now * 1e9), 10**9), "<u4").tobytes()
    clouds(message.cloud[: STAMP.start] + stamp + message.cloud[STAMP.stop :])


def _stamp(found: bytes) -> float:
    seconds, nanoseconds = np.frombuffer(found, "<u4").tolist()
    return seconds + nanoseconds / 1e9


def _resident_mb(process: int) -> float:
    """Memory of a process, in MB."""
    return int(Path(f"/proc/{process}/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE") / 1e6


def _free_endpoint() -> str:
    with socket.socket() as found:
        found.bind(("127.0.0.1", 0))
        return f"tcp/127.0.0.1:{found.getsockname()[1]}"


def show(sent: int, dropped: int, found: Latencies, memory: list[float]) -> None:
    """Print the table."""
    rows = {
        "published scan to transform": found.frames,
        "of these, in bin/live": found.inside,
        "published scan to loop edge": found.loops,
    }
    table = Table("", "number", "median ms", "99 % ms")
    for name, values in rows.items():
        middle, late = (f"{1e3 * np.quantile(values, share):.1f}" for share in (0.5, 0.99)) if values else ("", "")
        table.add_row(name, f"{len(values):,}", middle, late)
    console = Console(width=100)
    console.print(table)
    console.print(f"{sent:,} scans sent, {dropped} dropped, {sent - dropped - len(found.frames)} lost")
    console.print(f"memory of bin/live: {' MB, then '.join(f'{one:.0f}' for one in memory)} MB")


if __name__ == "__main__":
    tyro.cli(main, description=__doc__)
