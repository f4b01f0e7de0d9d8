"""Connection to ROS 2 by rclpy. Messages stay encoded: `RosSource` and `RosSink` decode and encode them."""

import time
from collections.abc import Callable, Collection
from functools import partial
from typing import Any

from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy
from rosidl_runtime_py.utilities import get_message

from sglpr_jax.files import in_short
from sglpr_jax.live.data_types import Report
from sglpr_jax.live.ros_encoding import Received
from sglpr_jax.live.ros_topics import Receive


class RclpyTransport:
    """Subscriptions and publishers of a node. See `sglpr_jax.live.ros_topics.Transport` for the methods.

    rclpy does not tell which publisher sent a message.
    """

    def __init__(self, node: Any, report: Report):
        """Use a node, which another thread spins."""
        self._node, self._report = node, report
        self._destructors: list[Callable[[], object]] = []

    def subscribe(
        self, topic: str, kinds: Collection[str], receive: Receive, *, depth: int, reliable: bool, latched: bool
    ) -> None:
        """Receive the messages of a topic of the type that is published now, if it is one of these, or else of the
        first type that is installed. A node can subscribe to one type of a topic only."""
        published = self.published().get(topic, set())
        for kind in [kind for kind in kinds if kind in published] or kinds:
            try:
                message_type = get_message(kind)
            except (ImportError, AttributeError, ValueError):  # such as Livox's, on a robot without one
                continue
            qos, take = _qos(depth, reliable=reliable, latched=latched), self._callback(topic, kind, receive)
            subscription = self._node.create_subscription(message_type, topic, take, qos, raw=True)
            self._destructors.append(partial(self._node.destroy_subscription, subscription))
            return

    def advertise(self, topic: str, kind: str, *, depth: int, latched: bool) -> Callable[[bytes], None]:
        """Return a function that publishes messages of one type."""
        qos = _qos(depth, reliable=True, latched=latched)
        publisher = self._node.create_publisher(get_message(kind), topic, qos)
        self._destructors.append(partial(self._node.destroy_publisher, publisher))
        return publisher.publish

    def published(self) -> dict[str, set[str]]:
        """Return the types of each topic that has a publisher."""
        topics = self._node.get_topic_names_and_types()
        return {topic: set(kinds) for topic, kinds in topics if self._node.count_publishers(topic)}

    def close(self) -> None:
        """Destroy the subscriptions and publishers. The node itself is not destroyed."""
        while self._destructors:
            self._destructors.pop()()

    def _callback(self, topic: str, kind: str, receive: Receive) -> Callable[[bytes], None]:
        """Return the callback of a subscription, which passes messages to `receive`."""

        def take(cdr: bytes) -> None:
            try:
                receive(Received(kind, bytes(cdr), None, time.monotonic()))
            except Exception as error:  # otherwise rclpy would end the node
                self._report(f"message {topic}", f"{topic}: expected a valid message, found {in_short(error)}")

        return take


def _qos(depth: int, *, reliable: bool, latched: bool) -> QoSProfile:
    return QoSProfile(
        depth=depth,
        history=HistoryPolicy.KEEP_LAST,
        reliability=ReliabilityPolicy.RELIABLE if reliable else ReliabilityPolicy.BEST_EFFORT,
        durability=DurabilityPolicy.TRANSIENT_LOCAL if latched else DurabilityPolicy.VOLATILE,
    )
