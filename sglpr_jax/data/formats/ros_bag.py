"""ROS recordings by rosbags (extra `ros`): .bag, .mcap, and folders of ROS 2."""

import itertools
import threading
import weakref
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from sglpr_jax.data.formats.bin_records import Records
from sglpr_jax.data.formats.livox import CUSTOM_MSG, POINT, read_custom_msg
from sglpr_jax.data.formats.point_cloud2 import described_fields, read_point_cloud2
from sglpr_jax.data.formats.ros_message import RosMessage
from sglpr_jax.data.formats.ros_poses import POSES, TRANSFORMS, read_transforms
from sglpr_jax.data.formats.ros_tracks import Stamps, Track, tracks_of

CLOUDS = ("sensor_msgs/msg/PointCloud2", *CUSTOM_MSG)
"""Types of messages that are scans."""


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
        clouds = tuple(sorted(topic for topic, kind in topics.items() if kind in CLOUDS))
        if not clouds:
            found = ", ".join(f"{topic} ({kind})" for topic, kind in sorted(topics.items())) or "no topics"
            raise ValueError(
                f"{self.paths[0]}: expected a topic of point clouds ({' or '.join(CLOUDS)}), found {found}"
            )
        return clouds

    @property
    def pose_topics(self) -> tuple[str, ...]:
        """The topics of poses."""
        return tuple(sorted(topic for topic, kind in self.topics.items() if kind in POSES))

    def stamps(self, topic: str) -> Stamps:
        """When the messages of a topic were made. Reads the bag once. Raises ValueError for a broken one."""
        with self._lock, _broken(self.paths[0]):
            found = [(time, message.header().time) for time, message in self._messages(topic)]
        return Stamps(np.array([time for time, _ in found], np.int64), np.array([time for _, time in found], float))

    def track(self, topic: str) -> Track:
        """The poses on a topic of poses, those that are finite. Reads the bag once."""
        read = POSES[self.topics[topic]]
        with self._lock, _broken(self.paths[0]):
            return Track.of((time, read(message)) for time, message in self._messages(topic))

    def transforms(self) -> list[Track]:
        """What tf says: the poses of each frame in its parent's. Reads the bag once for each topic of tf."""
        topics = sorted(topic for topic, kind in self.topics.items() if kind in TRANSFORMS)
        with self._lock, _broken(self.paths[0]):
            messages = [pair for topic in topics for pair in self._messages(topic)]
            return tracks_of((time, pose) for time, message in messages for pose in read_transforms(message))

    def frame(self, topic: str, time: int) -> str:
        """The frame of a message recorded at this time (ns), as its header says."""
        with self._lock, _broken(self.paths[0]):
            return next(self._messages(topic, time))[1].header().frame

    def cloud(self, topic: str, time: int, nth: int) -> Records:
        """The `nth` cloud of a topic among those recorded at this time (ns). Raises ValueError for a broken one."""
        with self._lock, _broken(self.paths[0]):
            if self.topics[topic] in CUSTOM_MSG:
                return read_custom_msg(next(itertools.islice(self._messages(topic, time), nth, None))[1])
            return read_point_cloud2(self._point_cloud2(topic, time, nth))

    def fields(self, topic: str, time: int) -> str:
        """The fields of a cloud, in words."""
        if self.topics[topic] in CUSTOM_MSG:
            return f"Livox, {' '.join(POINT)}"
        with self._lock, _broken(self.paths[0]):
            return described_fields(self._point_cloud2(topic, time, 0))

    def _messages(self, topic: str, time: int | None = None) -> Iterator[tuple[int, RosMessage]]:
        """The messages of a topic, or those recorded at one time (ns), with their times."""
        for _, recorded, raw in self._raw(topic, time):
            yield recorded, RosMessage(raw, cdr=self._reader.is2)

    def _raw(self, topic: str, time: int | None) -> Any:
        connections = [connection for connection in self._reader.connections if connection.topic == topic]
        stop = None if time is None else time + 1
        return self._reader.messages(connections=connections, start=time, stop=stop)

    def _point_cloud2(self, topic: str, time: int, nth: int) -> Any:
        connection, _, raw = next(itertools.islice(self._raw(topic, time), nth, None))
        return self._reader.deserialize(raw, connection.msgtype)


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
