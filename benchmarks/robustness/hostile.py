"""bin/live with a publisher that damages messages of every kind, beside bin/live with the good messages alone.

A process publishes a simulated drive, there and back, on two networks: the good messages on both, and damaged ones on
the first. Both nodes see the same scans with the same times, so that their loops can be compared.
"""

import contextlib
import multiprocessing
import random
import re
import tempfile
import time
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.speed.live import PUBLISHERS, LiveProcess, cloud_fields, scans_at
from benchmarks.table import Table
from sglpr_jax.live.ros_encoding import CLOUD, CLOUD_TYPES, TRANSFORMS, encode, header
from sglpr_jax.live.ros_odometry import ODOMETRY_TYPES
from sglpr_jax.live.ros_topics import STATIC_TOPIC
from sglpr_jax.models.shipped import DEFAULT_WEIGHTS
from sglpr_jax.se3 import inverse, quaternions, transform
from tests.fuzz.damage import damage

KINDS = [
    *(("/points", kind) for kind in CLOUD_TYPES),
    *(("/odometry", kind) for kind in ODOMETRY_TYPES),
    (STATIC_TOPIC, TRANSFORMS),
]
"""Topics and types of messages that are damaged."""
CONNECT_S = 6.0
"""Time in which the nodes find the publisher, in seconds."""
BEGIN_M = 100.0, 100.0
"""Begin of the odometry, in metres. A return to its origin would look like its restart."""
SAME_S, SAME_PLACE_M = 1.0, 20.0
"""Time between the queries, and distance of the matches, of loops of the same two places."""
SAME_M, SAME_DEG = 0.3, 3.0
"""Difference of the transforms of loops that are the same."""
WRONG_M = 1.0
"""Error of the transform of a wrong loop, in metres."""
NUMBERS = (0.0, np.nan, np.inf, 1e30, -1e30, 500.0)
"""Coordinates that a strange point, position or quaternion has."""
TIMES_S = (-1e10, -3600.03, -5.03, 5.03, 30.03, 3600.03, 1e9)
"""Errors of strange times, in seconds. Times that a message cannot hold become 0."""


class HostilePublisher:
    """Publishes damaged messages beside good ones, on the topics of the good ones and as the same publisher."""

    def __init__(self, name: str, where: str, seed: int):
        good = self._good = PUBLISHERS[name](where)  # kept, because the session closes when nothing refers to it
        self._send: dict[tuple[str, str], Callable[[bytes], None]] = dict(
            zip((("/points", CLOUD), ("/odometry", TRANSFORMS)), good.topics, strict=True)
        )
        for topic, kind in set(KINDS) - set(self._send):
            self._send[topic, kind] = good.wire.advertise(topic, kind, depth=1, latched=topic == STATIC_TOPIC)
        self._chance, self.damaged = random.Random(seed), 0

    def put(self, good: dict[tuple[str, str], bytes], scan: tuple[Any, ...], share: float) -> None:
        """Send the good messages of a scan. `share` is that of damaged messages among all that are sent."""
        for key, whole in good.items():
            messages = [(key, whole)]
            if self._chance.random() < share / (1 - share):
                another = self._chance.choice(KINDS)
                messages.insert(self._chance.randrange(2), (another, self._damaged(another[1], *scan)))
                self.damaged += 1
            for one, raw in messages:
                self._send[one](raw)

    def _damaged(self, kind: str, points: np.ndarray, pose: np.ndarray, stamp: float) -> bytes:
        """A message of a scan with other bytes, or with a strange time, name of a frame, coordinate or quaternion."""
        chance, names = self._chance, ["odom", "lidar"]
        position, quaternion = pose[:3, 3].copy(), quaternions(pose[None])[0]
        match chance.choice(("bytes", "time", "name", "content")):
            case "bytes":
                return damage(_encoded(kind, points, position, quaternion, stamp, names), chance)
            case "time":
                stamp += chance.choice(TIMES_S)
            case "name":
                names[chance.randrange(2)] = chance.choice(("", "base", chance.randbytes(5).hex()))
            case _:
                points = self._strange(points)
                numbers = chance.choice((position, quaternion))
                numbers[chance.randrange(len(numbers))] = chance.choice(NUMBERS)
        return _encoded(kind, points, position, quaternion, stamp, names)

    def _strange(self, points: np.ndarray) -> np.ndarray:
        """Points of another number, or with strange coordinates, or anywhere."""
        chance = self._chance
        match chance.choice(("few", "some", "all", "anywhere")):
            case "few":
                return points[: chance.randint(0, 3)]
            case "some":
                return np.where(np.arange(len(points))[:, None] % 3, points, chance.choice(NUMBERS))
            case "all":
                return np.full_like(points, chance.choice(NUMBERS))
            case _:
                return np.random.default_rng(chance.randrange(2**32)).uniform(-80, 80, points.shape)


def _encoded(
    kind: str, points: np.ndarray, position: np.ndarray, quaternion: np.ndarray, stamp: float, names: list[str]
) -> bytes:
    """A message of a kind about a scan, with the names of the reference frame and of the sensor's."""
    place, turn = dict(zip("xyz", map(float, position), strict=True)), dict(zip("xyzw", quaternion, strict=True))
    frame, child = names
    if kind in CLOUD_TYPES:
        some = [dict(zip("xyz", map(float, point), strict=True)) for point in points[::50]]
        fields = cloud_fields(points, stamp) if kind == CLOUD else {"point_num": len(some), "points": some}
        return encode(kind, {**fields, "header": header(stamp, child)})
    if kind == TRANSFORMS:
        moved = {"translation": place, "rotation": turn}
        return encode(
            kind, {"transforms": [{"header": header(stamp, frame), "child_frame_id": child, "transform": moved}]}
        )
    pose = {"position": place, "orientation": turn}
    fields = {"pose": {"pose": pose}, "child_frame_id": child} if kind.endswith("Odometry") else {"pose": pose}
    return encode(kind, {"header": header(stamp, frame), **fields})


def hostile(
    *,
    source: str = "dds:78",
    minutes: float = 30.0,
    rate: float = 10.0,
    share: float = 0.2,
    seed: int = 0,
    scans: int = 240,
    weights: str = DEFAULT_WEIGHTS,
) -> None:
    """Run bin/live with damaged messages, and beside it without them. Prints a table of both.

    Args:
        source: dds:DOMAIN or zenoh:ENDPOINT, which ends with a port. The good messages alone are at the next one.
        minutes: duration.
        rate: scans a second.
        share: share of damaged messages among all.
        seed: seed of the damage.
        scans: scans of the simulated drive.
        weights: weights of bin/live.
    """
    name, _, where = source.partition(":")
    number = re.search(r"[0-9]+$", where)
    if number is None:
        raise SystemExit(f"error: expected dds:DOMAIN or zenoh:ENDPOINT, found {source}")
    places = (where[: number.start()] + str(int(number[0]) + 1), where)
    count = int(60 * minutes * rate)
    with tempfile.TemporaryDirectory() as folder, contextlib.ExitStack() as ending:
        sent, nodes = Path(folder) / "sent.npz", list[LiveProcess]()
        for one, place in zip(("good", "damaged"), places, strict=True):
            (Path(folder) / one).mkdir()
            nodes.append(LiveProcess(name, place, Path(folder) / one, weights))
            ending.callback(nodes[-1].close)
        for node in nodes:
            node.wait_until(lambda node=node: "ready:" in node.log.read_text())
        process = multiprocessing.get_context("spawn").Process(
            target=_publish, args=(name, places, sent, rate, count, scans, share, seed)
        )
        process.start()
        process.join()
        time.sleep(1.0)
        with np.load(sent) as arrays:
            stamps, poses, damaged = (arrays[key] for key in ("stamps", "poses", "damaged"))
        rows = [_row(node) for node in nodes]
        loops = [_Loops(node.loops, stamps, poses) for node in nodes]
        for row, ours, others in zip(rows, loops, loops[::-1], strict=True):
            row |= {"loops": len(ours.errors_m), "which the other node has, too": ours.found_by(others)}
            row |= {"wrong loops": int((ours.errors_m > WRONG_M).sum()), "loops of no good scan": ours.unknown}
        warnings = [_warnings(node.log.read_text()) for node in nodes]
    table = Table("", "good messages alone", "with damaged ones")
    table.add("messages", 2 * count, 2 * count + int(damaged))
    for what in rows[0]:
        table.add(what, *(row[what] for row in rows))
    for what in sorted(set().union(*warnings)):
        table.add(what, *(one[what] for one in warnings))


def _publish(
    name: str, places: tuple[str, str], sent: Path, rate: float, count: int, scans: int, share: float, seed: int
) -> None:
    """Publish scans for both nodes, and write their times and poses to a file, in a process of its own."""
    stamps, poses, begin = np.zeros(count), np.zeros((count, 4, 4)), 0.0
    publishers = [HostilePublisher(name, where, seed) for where in places]
    time.sleep(CONNECT_S)
    for i, (points, at) in enumerate(scans_at(rate, count, scans)):
        pose = transform(*BEGIN_M, 0.0) @ at
        begin = begin or time.time()
        stamps[i], poses[i] = begin + i / rate, pose
        scan = points, pose, float(stamps[i])
        turn = quaternions(pose[None])[0]
        good = {
            (topic, kind): _encoded(kind, points, pose[:3, 3], turn, float(stamps[i]), ["odom", "lidar"])
            for topic, kind in (("/odometry", TRANSFORMS), ("/points", CLOUD))
        }
        for publisher, part in zip(publishers, (0.0, share), strict=True):
            publisher.put(good, scan, part)
    np.savez(sent, stamps=stamps, poses=poses, damaged=publishers[-1].damaged)


def _row(node: LiveProcess) -> dict[str, Any]:
    """End a node. Returns what it took and whether it was well."""
    is_alive, memory = node.is_alive, node.memory() if node.is_alive else None
    status, log = node.close(), node.log.read_text()
    left_out = re.findall(r"([0-9]+) left out", log)
    return {
        "alive": "yes" if is_alive else "no",
        "exit status": status,
        "tracebacks": log.count("Traceback"),
        "scans taken": len(node.frames),
        "dropped": node.frames[-1]["dropped"],
        "left out": left_out[-1] if left_out else "",
        "places": node.frames[-1]["places"],
        "resident [MB]": f"{memory.resident_mb:.0f}" if memory else "",
    }


class _Loops:
    """Loops of a node between good scans, with the true poses of the scans."""

    def __init__(self, loops: list[dict], stamps: np.ndarray, poses: np.ndarray):
        times = np.array([(loop["query_time"], loop["match_time"]) for loop in loops]).reshape(-1, 2)
        rows = np.searchsorted((stamps[1:] + stamps[:-1]) / 2, times)  # the nearest good scans
        is_good = (np.abs(stamps[rows] - times) < 1e-3).all(axis=1)
        self.unknown = int((~is_good).sum())
        self.times = times[is_good, 0]
        self.query, self.match = poses[rows[is_good]].swapaxes(0, 1)
        self.found = np.array([loop["match_from_query"] for loop in loops]).reshape(-1, 4, 4)[is_good]
        self.errors_m = np.linalg.norm((inverse(self.found) @ inverse(self.match) @ self.query)[:, :3, 3], axis=1)

    def found_by(self, other: "_Loops") -> int:
        """Number of loops for which another node has one of the same two places with the same transform."""
        count = 0
        for time_s, query, match, found in zip(self.times, self.query, self.match, self.found, strict=True):
            near = np.abs(other.times - time_s) <= SAME_S
            near &= np.linalg.norm(other.match[:, :3, 3] - match[:3, 3], axis=1) <= SAME_PLACE_M
            # The other loop's transform between this loop's scans, by the true motion from scan to scan.
            theirs = inverse(match) @ other.match[near] @ other.found[near] @ inverse(other.query[near]) @ query
            apart = inverse(found) @ theirs
            angles = np.degrees(np.arccos(np.clip((np.trace(apart, axis1=1, axis2=2) - 1) / 2, -1, 1)))
            count += bool(((np.linalg.norm(apart[:, :3, 3], axis=1) <= SAME_M) & (angles <= SAME_DEG)).any())
        return count


def _warnings(log: str) -> Counter[str]:
    """Number of warnings by what was expected, with those that were counted and not printed."""
    counts: Counter[str] = Counter()
    for line in log.splitlines():
        more = re.search(r" \(([0-9]+) more since the last line\)$", line)
        text = re.split(r", found| \(", line)[0]
        if "expected" in line or more or text.startswith("the odometry"):
            counts[re.sub(r"[0-9.]+", "N", text)] += 1 + (int(more[1]) if more else 0)
    return counts
