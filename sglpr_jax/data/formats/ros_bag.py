"""Reads bags of ROS 1 and ROS 2 with rosbags (extra `ros`): topics, times, clouds, poses and IMU."""

import contextlib
import itertools
import threading
import weakref
from collections.abc import Callable, Container, Iterator, Sequence
from pathlib import Path
from typing import Any, TypeVar

from sglpr_jax.data.formats.ros_messages import CUSTOM_MSG, POINT, RosMessage, read_custom_msg, read_point_cloud2
from sglpr_jax.data.scan import Scan
from sglpr_jax.files import in_short

CLOUDS = ("sensor_msgs/msg/PointCloud2", *CUSTOM_MSG)
"""Message types of scans."""
METADATA = "metadata.yaml"
"""File that describes a ROS 2 recording. The recorder writes it at the end."""
COMPRESSED = (".db3.zstd", ".mcap.zstd")
"""Endings of compressed files, which only their metadata describe."""
T = TypeVar("T")


class RosBag:
    """An open bag. It is closed when the object is garbage-collected.

    Each method that reads messages raises ValueError if the bag is broken.
    """

    def __init__(self, paths: Sequence[Path]):
        self.paths = tuple(paths)
        self.name = self.paths[0].name
        self._reader = _open(self.paths)
        self._lock = threading.Lock()
        weakref.finalize(self, self._reader.close)

    @property
    def files(self) -> tuple[Path, ...]:
        """Files of all bags, in order."""
        return tuple(file for path in self.paths for file in (sorted(path.iterdir()) if path.is_dir() else (path,)))

    @property
    def topics(self) -> dict[str, str]:
        """All topics, with their message types."""
        return {connection.topic: connection.msgtype for connection in self._reader.connections}

    @property
    def parts(self) -> list[tuple[Path, int, int]]:
        """Path of each bag with messages, and the recorder's times (ns) of its first and last message."""
        spans = zip(self.paths, self._reader.readers, strict=True)
        return [(path, part.start_time, part.end_time) for path, part in spans if part.message_count]

    def topics_of(self, kinds: Container[str]) -> tuple[str, ...]:
        """Return the topics with one of some message types, in order of their names."""
        return tuple(sorted(topic for topic, kind in self.topics.items() if kind in kinds))

    @property
    def cloud_topics(self) -> tuple[str, ...]:
        """Point cloud topics. Raises ValueError, with a list of all topics, if the bag has no point clouds."""
        clouds = self.topics_of(CLOUDS)
        if not clouds:
            topics = ", ".join(f"{topic} ({kind})" for topic, kind in sorted(self.topics.items())) or "no topics"
            expected = f"a topic of point clouds ({' or '.join(CLOUDS)})"
            raise ValueError(f"{self.paths[0]}: expected {expected}, found {topics}")
        return clouds

    def cloud(self, topic: str, time: int, nth: int) -> Scan:
        """Return the `nth` cloud among those of a topic recorded at `time` (ns). Raises ValueError if it is empty."""
        kind, message = self.topics[topic], self.message(topic, time, nth)
        try:
            if kind in CUSTOM_MSG:
                return read_custom_msg(message)
            return read_point_cloud2(self._reader.deserialize(message.raw, kind), name=str(self.paths[0]))
        except Exception as error:  # the bag defines the types and names of the fields
            found = f"found an invalid one ({in_short(error)})"
            raise ValueError(f"{self.paths[0]}: expected a cloud with points on {topic}, {found}") from error

    def fields(self, topic: str, time: int) -> str:
        """Return a description of the fields of a cloud: "x y z intensity ring (22 bytes a point)"."""
        if self.topics[topic] in CUSTOM_MSG:
            return f"Livox, {' '.join(POINT)}"
        with _naming(self.paths[0]):
            cloud = self._reader.deserialize(self.message(topic, time).raw, self.topics[topic])
        return f"{' '.join(field.name for field in cloud.fields)} ({cloud.point_step} bytes a point)"

    def message(self, topic: str, time: int, nth: int = 0) -> RosMessage:
        """Return the `nth` message among those of a topic recorded at `time` (ns)."""
        return self.read(topic, lambda messages: next(itertools.islice(messages, nth, None))[1], time)

    def read(self, topic: str, decode: Callable[[Iterator[tuple[int, RosMessage]]], T], time: int | None = None) -> T:
        """Decode the messages of a topic with their times (ns), or only those recorded at one time."""
        with self._lock, _naming(self.paths[0]):
            return decode(self._messages(topic, time))

    def _messages(self, topic: str, time: int | None) -> Iterator[tuple[int, RosMessage]]:
        """Messages with their times. Raises ValueError after the last message if the bag declares more."""
        connections = [connection for connection in self._reader.connections if connection.topic == topic]
        stop = None if time is None else time + 1
        count = 0
        for _, recorded, raw in self._reader.messages(connections=connections, start=time, stop=stop):
            count += 1
            yield recorded, RosMessage(raw, cdr=self._reader.is2)
        declared = sum(connection.msgcount for connection in connections)
        if time is None and count < declared:
            raise ValueError(f"expected {declared} messages on {topic} by its statistics, found {count}")


def _open(paths: tuple[Path, ...]) -> Any:
    try:
        from rosbags.highlevel import AnyReader
        from rosbags.typesys import Stores, get_typestore
    except ImportError as error:
        raise ImportError(f"{paths[0]}: bags need the extra `ros` (pip install 'sglpr-jax[ros]')") from error
    if paths[0].name.endswith(COMPRESSED):
        raise ValueError(f"{paths[0]}: expected a file that is not compressed{_metadata_hint(paths[0])}")
    for path in paths:
        _check_closed(path)
    with _naming(paths[0]):
        reader = AnyReader(list(paths), default_typestore=get_typestore(Stores.ROS2_HUMBLE))
        reader.open()
        return reader


@contextlib.contextmanager
def _naming(path: Path) -> Iterator[None]:
    """Convert exceptions of rosbags to a ValueError that names the bag."""
    try:
        yield
    except (ImportError, FileNotFoundError):
        raise
    except Exception as error:
        found = f"found a broken one ({in_short(error)}){_metadata_hint(path)}"
        raise ValueError(f"{path}: expected an intact ROS bag, {found}") from error


def _metadata_hint(path: Path) -> str:
    """Hint about the metadata of a broken ROS 2 recording. A recorder that is killed writes none."""
    metadata = path.parent / METADATA
    if path.is_dir():
        return f"; {METADATA} or a file that it lists is damaged"
    if path.suffix == ".bag":
        return ""
    missing = f"; {metadata} is missing (ros2 bag reindex writes it)"
    return f"; open the folder with {metadata}" if metadata.is_file() else missing


def _check_closed(path: Path) -> None:
    """Raise ValueError if SQLite has a log beside a file of a bag: it holds messages that the file lacks."""
    for file in sorted(path.glob("*.db3")) if path.is_dir() else (path,):
        for log in (file.with_name(f"{file.name}-wal"), file.with_name(f"{file.name}-journal")):
            if log.is_file() and log.stat().st_size:
                raise ValueError(
                    f"{file}: expected a bag that its recorder has closed, found {log.name} beside it, with changes "
                    f"that are not in the bag; `sqlite3 {file.name} 'PRAGMA wal_checkpoint(TRUNCATE)'` merges them"
                )
