"""Reads bags of ROS 1 and ROS 2 with rosbags (extra `ros`): topics, times, clouds, poses and IMU."""

import contextlib
import itertools
import threading
import weakref
from collections.abc import Callable, Container, Iterator, Sequence
from pathlib import Path
from typing import Any, TypeVar

from sglpr_jax.data.formats.ros_messages import CUSTOM_MSG, LIVOX_FIELDS, RosMessage, read_custom_msg, read_point_cloud2
from sglpr_jax.data.scan import Scan
from sglpr_jax.extras import install_command
from sglpr_jax.files import in_short

CLOUDS = ("sensor_msgs/msg/PointCloud2", *CUSTOM_MSG)
"""Message types of scans."""
METADATA = "metadata.yaml"
"""File that describes a ROS 2 recording. The recorder writes it at the end."""
COMPRESSED = (".db3.zstd", ".mcap.zstd")
"""Endings of compressed files, which can only be opened by their metadata."""
T = TypeVar("T")


class RosBag:
    """One or more bags that are read as one. Each method that reads messages raises ValueError if a bag is broken."""

    def __init__(self, paths: Sequence[Path]):
        self.paths = tuple(paths)
        self.name = self.paths[0].name
        self._reader = _open_reader(self.paths)
        self._lock = threading.Lock()
        weakref.finalize(self, self._reader.close)  # closes the bags when the object is garbage-collected

    @property
    def files(self) -> tuple[Path, ...]:
        """Files of all bags, in order. A bag of ROS 2 may be a folder."""
        return tuple(file for path in self.paths for file in (sorted(path.iterdir()) if path.is_dir() else (path,)))

    @property
    def topics(self) -> dict[str, str]:
        """All topics, with their message types."""
        return {connection.topic: connection.msgtype for connection in self._reader.connections}

    @property
    def time_spans(self) -> list[tuple[Path, int, int]]:
        """Path of each bag with messages, and the recorder's times (ns) of its first and last message."""
        readers = zip(self.paths, self._reader.readers, strict=True)
        return [(path, reader.start_time, reader.end_time) for path, reader in readers if reader.message_count]

    def topics_of(self, message_types: Container[str]) -> tuple[str, ...]:
        """Return the topics whose message type is in `message_types`, in order of their names."""
        return tuple(sorted(topic for topic, message_type in self.topics.items() if message_type in message_types))

    @property
    def cloud_topics(self) -> tuple[str, ...]:
        """Point cloud topics. Raises ValueError, with a list of all topics, if the bag has no point clouds."""
        cloud_topics = self.topics_of(CLOUDS)
        if not cloud_topics:
            topics = ", ".join(f"{topic} ({kind})" for topic, kind in sorted(self.topics.items())) or "no topics"
            expected = f"a topic of point clouds ({' or '.join(CLOUDS)})"
            raise ValueError(f"{self.paths[0]}: expected {expected}, found {topics}")
        return cloud_topics

    def cloud(self, topic: str, recorder_ns: int, nth: int) -> Scan:
        """Return a point cloud. `recorder_ns` and `nth` are those of `message`. Raises ValueError if it is invalid."""
        message_type = self.topics[topic]
        message = self.message(topic, recorder_ns, nth)
        try:
            if message_type in CUSTOM_MSG:
                return read_custom_msg(message)
            return read_point_cloud2(self._reader.deserialize(message.raw, message_type), name=str(self.paths[0]))
        except Exception as error:  # many types, because the bag defines the types and names of the fields
            found = f"found an invalid one ({in_short(error)})"
            raise ValueError(f"{self.paths[0]}: expected a cloud with points on {topic}, {found}") from error

    def describe_fields(self, topic: str, recorder_ns: int) -> str:
        """Return a description of the fields of a cloud: "x y z intensity ring (22 bytes a point)"."""
        if self.topics[topic] in CUSTOM_MSG:
            return f"Livox, {' '.join(LIVOX_FIELDS)}"
        with _bag_errors(self.paths[0]):
            cloud = self._reader.deserialize(self.message(topic, recorder_ns).raw, self.topics[topic])
        return f"{' '.join(field.name for field in cloud.fields)} ({cloud.point_step} bytes a point)"

    def message(self, topic: str, recorder_ns: int, nth: int = 0) -> RosMessage:
        """Return message `nth`, counted from 0, of the messages of a topic that were recorded at `recorder_ns`."""
        return self.read(topic, lambda messages: next(itertools.islice(messages, nth, None))[1], recorder_ns)

    def read(
        self, topic: str, decode: Callable[[Iterator[tuple[int, RosMessage]]], T], recorder_ns: int | None = None
    ) -> T:
        """Call `decode` with the messages of a topic (recorded at `recorder_ns`) and the recorder time (ns) of each."""
        with self._lock, _bag_errors(self.paths[0]):
            return decode(self._messages(topic, recorder_ns))

    def _messages(self, topic: str, time: int | None) -> Iterator[tuple[int, RosMessage]]:
        """Yield the messages of `read`. Raises ValueError after the last message if the bag declares more."""
        connections = [connection for connection in self._reader.connections if connection.topic == topic]
        stop = None if time is None else time + 1
        count = 0
        for _, recorder_ns, raw in self._reader.messages(connections=connections, start=time, stop=stop):
            count += 1
            yield recorder_ns, RosMessage(raw, cdr=self._reader.is2)
        declared = sum(connection.msgcount for connection in connections)
        if time is None and count < declared:
            raise ValueError(f"expected {declared} messages on {topic} by its statistics, found {count}")


def _open_reader(paths: tuple[Path, ...]) -> Any:
    """Open bags with rosbags. Raises ValueError for compressed files and bags that are broken or still recorded."""
    try:
        from rosbags.highlevel import AnyReader
        from rosbags.typesys import Stores, get_typestore
    except ImportError as error:
        raise ImportError(f"{paths[0]}: bags need the extra `ros` ({install_command('ros')})") from error
    if paths[0].name.endswith(COMPRESSED):
        raise ValueError(f"{paths[0]}: expected a file that is not compressed{_metadata_hint(paths[0])}")
    for path in paths:
        _check_closed(path)
    with _bag_errors(paths[0]):
        reader = AnyReader(list(paths), default_typestore=get_typestore(Stores.ROS2_HUMBLE))
        reader.open()
        return reader


@contextlib.contextmanager
def _bag_errors(path: Path) -> Iterator[None]:
    """Convert exceptions of rosbags to a ValueError that names the bag."""
    try:
        yield
    except (ImportError, FileNotFoundError):
        raise
    except Exception as error:
        found = f"found a broken one ({in_short(error)}){_metadata_hint(path)}"
        raise ValueError(f"{path}: expected an intact ROS bag, {found}") from error


def _metadata_hint(path: Path) -> str:
    """Return how to open a broken ROS 2 recording with its metadata. A recorder that is killed writes no metadata."""
    if path.is_dir():
        return f"; {METADATA} or a file that it lists is damaged"
    if path.suffix == ".bag":  # ROS 1 has no metadata file
        return ""
    metadata = path.parent / METADATA
    if metadata.is_file():
        return f"; open the folder with {metadata}"
    return f"; {metadata} is missing (ros2 bag reindex writes it)"


def _check_closed(path: Path) -> None:
    """Raise ValueError if SQLite left a log beside a .db3 file of a bag: the log holds messages that the file lacks."""
    for file in sorted(path.glob("*.db3")) if path.is_dir() else (path,):
        for log in (file.with_name(f"{file.name}-wal"), file.with_name(f"{file.name}-journal")):
            if log.is_file() and log.stat().st_size:
                raise ValueError(
                    f"{file}: expected a bag that its recorder has closed, found {log.name} beside it, with changes "
                    f"that are not in the bag; `sqlite3 {file.name} 'PRAGMA wal_checkpoint(TRUNCATE)'` merges them"
                )
