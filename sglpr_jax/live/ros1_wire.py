"""Connection to ROS 1 by rospy, where it is installed: by Debian's packages, or by the setup.bash of ROS.

Messages stay encoded. Those that this project publishes have the definitions of ROS 1, by rosbags, so no packages of
messages are needed.
"""

import functools
import importlib
import importlib.util
import os
import socket
import sys
import time
from collections import deque
from collections.abc import Callable, Collection
from typing import Any
from urllib.parse import urlsplit

from rosbags.typesys import Stores, get_typestore

from sglpr_jax.files import in_short
from sglpr_jax.live.report import Report
from sglpr_jax.live.ros_messages import CLOUDS, TRANSFORMS, ros1_typestore, typestore
from sglpr_jax.live.ros_wire import Receive, Received

MASTER = "http://localhost:11311"
"""Usual address of a roscore."""
DEBIAN = "/usr/lib/python3/dist-packages"
"""Folder of Debian's packages of ROS 1. It is searched last, because it also contains an older numpy."""
ANSWER_S = 5.0
"""Maximum time in which a roscore accepts a connection, in seconds."""
BUFFER = 16 * 2**20
"""Receive buffer in bytes. rospy drops old messages only if it is larger than the messages."""
ALIASES = {"livox_ros_driver/msg/CustomMsg": CLOUDS[1], "tf/msg/tfMessage": TRANSFORMS}
"""Other names of the same types."""


class Ros1Wire:
    """Node of ROS 1. All connections of a process share it. See `ros_wire.Wire`."""

    def __init__(self, master: str, report: Report):
        """Register the node.

        Arguments:
          master: Address of the roscore. If it is empty, that of ROS_MASTER_URI, or else the one on this computer.
          report: Function for trouble with single messages.

        Raises:
          ImportError: If rospy is not installed.
          ValueError: If no roscore answers there, or the process uses another one.
        """
        self._report, self._rospy = report, _rospy()
        _start(self._rospy, master or os.environ.get("ROS_MASTER_URI") or MASTER)
        self._opened: list[Any] = []

    def subscribe(
        self, topic: str, kinds: Collection[str], receive: Receive, *, depth: int, reliable: bool, latched: bool
    ) -> None:
        """Receive the messages of a topic that have one of these types. ROS 1 has no other settings."""

        def take(message: Any) -> None:
            try:
                about = message._connection_header
                kind = _kind(about["type"])
                if kind in kinds:
                    receive(Received(kind, message._buff, about["callerid"], time.monotonic(), cdr=False))
            except Exception as error:  # rospy would print it and go on
                self._report(f"message {topic}", f"{topic}: expected a valid message, found {in_short(error)}")

        settings = {"queue_size": depth, "buff_size": BUFFER, "tcp_nodelay": True}
        self._opened.append(self._rospy.Subscriber(topic, self._rospy.AnyMsg, take, **settings))

    def advertise(self, topic: str, kind: str, *, depth: int, latched: bool) -> Callable[[bytes], None]:
        """Return a function that publishes messages of one type."""
        kept: deque[Any] = deque(maxlen=depth)

        class Late(self._rospy.SubscribeListener):
            """Sends the kept messages to a new subscriber. ROS 1 itself keeps only one."""

            def peer_subscribe(self, topic_name: str, topic_publish: Any, peer_publish: Callable[[Any], None]) -> None:
                for message in tuple(kept):
                    peer_publish(message)

        new = _class_of(kind)
        settings = {"queue_size": depth, "tcp_nodelay": True, "subscriber_listener": Late() if latched else None}
        publisher = self._rospy.Publisher(topic, new, **settings)
        self._opened.append(publisher)

        def publish(cdr: bytes) -> None:
            message = new()
            message._buff = _ros1_of(cdr, kind)
            kept.append(message)
            publisher.publish(message)

        return publish

    def published(self) -> dict[str, set[str]]:
        """Topics with a publisher, and their types. Reports if the roscore has ended."""
        found: dict[str, set[str]] = {}
        try:
            topics = self._rospy.get_published_topics()
        except Exception as error:  # of xmlrpc, http and sockets
            self._report("master", f"{_master()}: expected a running roscore, found none ({in_short(error)})")
            return found
        for topic, kind in topics:
            found.setdefault(topic, set()).add(_kind(kind))
        return found

    def close(self) -> None:
        """End the subscriptions and publishers. The node itself ends with the process."""
        for one in self._opened:
            one.unregister()


def _rospy() -> Any:
    """Import rospy."""
    if importlib.util.find_spec("rospy") is None:
        if not os.path.isdir(os.path.join(DEBIAN, "rospy")):
            raise ImportError(
                "ros1: expected the package rospy, found none; install python3-rospy (Debian), or source the "
                "setup.bash of ROS 1"
            )
        sys.path.append(DEBIAN)
    return importlib.import_module("rospy")


def _start(rospy: Any, master: str) -> None:
    """Register the node of this process, once."""
    if rospy.core.is_initialized():
        if master != _master():
            raise ValueError(f"ros1: expected one roscore in a process, found {_master()} and {master}")
        return
    try:
        where = urlsplit(master)
        if where.scheme != "http":
            raise ValueError("no address such as http://host:11311")
        socket.create_connection((where.hostname or "", where.port or 11311), ANSWER_S).close()
    except (OSError, ValueError) as error:
        raise ValueError(f"ros1: expected a running roscore at {master}, found none ({in_short(error)})") from error
    os.environ["ROS_MASTER_URI"] = master
    rospy.init_node("sglpr", argv=[], anonymous=True, disable_signals=True, disable_rosout=True, disable_rostime=True)


def _master() -> str:
    return os.environ["ROS_MASTER_URI"]


def _kind(name: str) -> str:
    """Type in the form of ROS 2: `sensor_msgs/msg/PointCloud2` of `sensor_msgs/PointCloud2`."""
    kind = name.replace("/", "/msg/")
    return ALIASES.get(kind, kind)


@functools.cache
def _class_of(kind: str) -> Any:
    """Class of encoded messages for rospy."""
    text, checksum = ros1_typestore().generate_msgdef(kind, ros_version=1)
    about = {"_type": kind.replace("/msg/", "/"), "_md5sum": checksum, "_full_text": text, "__slots__": ()}
    return type(kind.rpartition("/")[2], (_rospy().AnyMsg,), about)


def _ros1_of(cdr: bytes, kind: str) -> bytes:
    """Encode a message of `typestore` for ROS 1. Its markers have the fields of ROS 2 Foxy."""
    foxy = _foxy()
    fewer = foxy.serialize_cdr(typestore().deserialize_cdr(cdr, kind), kind)
    return bytes(foxy.cdr_to_ros1(fewer, kind))


@functools.cache
def _foxy() -> Any:
    return get_typestore(Stores.ROS2_FOXY)
