"""ROS recordings by rosbags (extra `ros`): .bag, .mcap, and folders of ROS 2."""

import itertools
import struct
import threading
import weakref
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Int64

from sglpr_jax.data.formats.bin_records import Records
from sglpr_jax.data.formats.point_cloud2 import described_fields, read_point_cloud2

CLOUD = "sensor_msgs/msg/PointCloud2"


class RosBag:
    """An open recording. It is closed when nobody holds it any longer."""

    def __init__(self, paths: Sequence[Path]):
        self.paths = tuple(paths)
        self.name = self.paths[0].name
        self._reader = _open(self.paths)
        self._lock = threading.Lock()
        weakref.finalize(self, self._reader.close)

    @property
    def topics(self) -> dict[str, str]:
        """All topics, and the type of each one's messages."""
        return {connection.topic: connection.msgtype for connection in self._reader.connections}

    @property
    def cloud_topics(self) -> tuple[str, ...]:
        """The topics of point clouds. Raises ValueError, with all topics there are, where there is none."""
        topics = self.topics
        clouds = tuple(sorted(topic for topic, kind in topics.items() if kind == CLOUD))
        if not clouds:
            found = ", ".join(f"{topic} ({kind})" for topic, kind in sorted(topics.items())) or "no topics"
            raise ValueError(f"{self.paths[0]}: expected a topic of point clouds ({CLOUD}), found {found}")
        return clouds

    def stamps(self, topic: str) -> tuple[Int64[np.ndarray, " n"], Float[np.ndarray, " n"]]:
        """When the messages of a topic were recorded (ns), and their own times (seconds).

        Reads the bag once. Messages whose own times go back have the recorder's. Raises ValueError for a broken bag.
        """
        with self._lock, _broken(self.paths[0]):
            found = [(time, self._own_time(raw)) for _, time, raw in self._messages(topic)]
        recorded = np.array([time for time, _ in found], np.int64)
        own = np.array([time for _, time in found], np.float64)
        orderly = len(own) and (own > 0).all() and (np.diff(own) >= 0).all()
        return recorded, own if orderly else recorded / 1e9

    def cloud(self, topic: str, time: int, nth: int) -> Records:
        """The `nth` cloud of a topic among those recorded at this time (ns). Raises ValueError for a broken one."""
        with self._lock, _broken(self.paths[0]):
            return read_point_cloud2(self._message(topic, time, nth))

    def fields(self, topic: str, time: int) -> str:
        """The fields of a cloud, in words."""
        with self._lock, _broken(self.paths[0]):
            return described_fields(self._message(topic, time, 0))

    def _messages(self, topic: str, start: int | None = None, stop: int | None = None) -> Any:
        connections = [connection for connection in self._reader.connections if connection.topic == topic]
        return self._reader.messages(connections=connections, start=start, stop=stop)

    def _message(self, topic: str, time: int, nth: int) -> Any:
        connection, _, raw = next(itertools.islice(self._messages(topic, time, time + 1), nth, None))
        return self._reader.deserialize(raw, connection.msgtype)

    def _own_time(self, raw: bytes) -> float:
        """The time in the header in front of every cloud, seconds."""
        if self._reader.is2:
            seconds, nanoseconds = struct.unpack_from("<iI" if raw[1] & 1 else ">iI", raw, 4)
        else:
            _, seconds, nanoseconds = struct.unpack_from("<III", raw)
        return seconds + nanoseconds / 1e9


class _broken:
    """Turns what rosbags raises inside into one ValueError that names the bag."""

    def __init__(self, path: Path):
        self._path = path

    def __enter__(self) -> None:
        pass

    def __exit__(self, kind: Any, error: BaseException | None, trace: Any) -> None:
        if isinstance(error, Exception) and not isinstance(error, ImportError | FileNotFoundError):
            said = str(error) or type(error).__name__
            raise ValueError(f"{self._path}: expected a whole recording of ROS, found a broken one ({said})") from error


def _open(paths: tuple[Path, ...]) -> Any:
    try:
        from rosbags.highlevel import AnyReader
        from rosbags.typesys import Stores, get_typestore
    except ImportError as error:
        raise ImportError(f"{paths[0]}: bags need the extra `ros` (pip install 'sglpr-jax[ros]')") from error
    with _broken(paths[0]):
        reader = AnyReader(list(paths), default_typestore=get_typestore(Stores.ROS2_HUMBLE))
        reader.open()
        return reader
