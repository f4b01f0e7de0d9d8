"""Interface of the connections to ROS (DDS, zenoh, rospy), and the names of topics and types on both."""

import os
from collections.abc import Callable, Collection
from typing import Any, NamedTuple, Protocol, runtime_checkable


class Received(NamedTuple):
    """A message as it arrived."""

    kind: str
    """Type, such as "sensor_msgs/msg/PointCloud2"."""
    raw: bytes
    """The encoded message."""
    publisher: Any
    """Value that tells one publisher of the topic from others."""
    at: float
    """Time of arrival by `time.monotonic()`, in seconds."""
    cdr: bool = True
    """Whether the message is encoded as ROS 2 does (CDR, with its encapsulation header), not as ROS 1."""


Receive = Callable[[Received], None]
"""Function that takes a message, in a thread of the connection. It must return at once."""


@runtime_checkable
class Wire(Protocol):
    """A connection to ROS. Topics and types have the names that `ros2 topic list -t` prints."""

    def subscribe(
        self, topic: str, kinds: Collection[str], receive: Receive, *, depth: int, reliable: bool, latched: bool
    ) -> None:
        """Receive the messages of a topic that have one of these types.

        Arguments:
          topic: Name of the topic.
          kinds: Types of the messages.
          receive: Function that takes a message.
          depth: Number of messages that wait for `receive`. Older ones are dropped.
          reliable: Whether lost messages are requested again.
          latched: Whether messages of before the subscription are requested.
        """
        ...

    def advertise(self, topic: str, kind: str, *, depth: int, latched: bool) -> Callable[[bytes], None]:
        """Return a function that publishes messages of one type, given as CDR. With `latched`, later subscribers
        receive the last `depth` messages."""
        ...

    def published(self) -> dict[str, set[str]]:
        """Topics with a publisher, and their types."""
        ...

    def close(self) -> None:
        """Release threads and connections."""
        ...


def full_name(topic: str) -> str:
    """Name of a topic with a slash at its beginning."""
    return f"/{topic.strip('/')}"


def domain_of(where: str, *, source: str) -> int:
    """Number of a ROS 2 domain: `where`, or else the environment variable ROS_DOMAIN_ID, or else 0.

    Raises ValueError if it is not from 0 to 232.
    """
    text = where or os.environ.get("ROS_DOMAIN_ID") or "0"
    if not (text.isdecimal() and int(text) <= 232):
        raise ValueError(f"{source}: expected a ROS 2 domain from 0 to 232, found {text}")
    return int(text)


def wire_type(kind: str) -> str:
    """Name of a type on the wire: `sensor_msgs::msg::dds_::PointCloud2_` of `sensor_msgs/msg/PointCloud2`."""
    package, folder, name = kind.split("/")
    return f"{package}::{folder}::dds_::{name}_"


def ros_type(name: str) -> str:
    """Name of a type in ROS 2, from its name on the wire."""
    return name.removesuffix("_").replace("::dds_::", "::").replace("::", "/")
