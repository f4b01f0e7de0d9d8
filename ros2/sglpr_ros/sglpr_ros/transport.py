"""Connection to ROS 2 by rclpy. Messages stay encoded: the source and the sink of `bin/live` read and write them."""

import time
from collections.abc import Callable, Collection
from typing import Any

from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy
from rosidl_runtime_py.utilities import get_message

from sglpr_jax.files import in_short
from sglpr_jax.live.node_messages import Report
from sglpr_jax.live.ros import Receive
from sglpr_jax.live.ros_encoding import Received


class RclpyTransport:
    """Subscriptions and publishers of a node. See `sglpr_jax.live.ros.Transport`.

    rclpy does not tell the publishers of a topic apart.
    """

    def __init__(self, node: Any, report: Report):
        """Use a node, which another thread spins."""
        self._node, self._report = node, report
        self._closing: list[Callable[[], object]] = []

    def subscribe(
        self, topic: str, kinds: Collection[str], receive: Receive, *, depth: int, reliable: bool, latched: bool
    ) -> None:
        """Receive the messages of a topic that have one of these types. Types that are not installed are left out."""
        for kind in kinds:
            try:
                of = get_message(kind)
            except (ImportError, AttributeError, ValueError):  # such as Livox's, on a robot without one
                continue
            qos, take = _qos(depth, reliable=reliable, latched=latched), self._taking(topic, kind, receive)
            subscription = self._node.create_subscription(of, topic, take, qos, raw=True)
            self._closing.append(lambda one=subscription: self._node.destroy_subscription(one))

    def advertise(self, topic: str, kind: str, *, depth: int, latched: bool) -> Callable[[bytes], None]:
        """Return a function that publishes messages of one type."""
        qos = _qos(depth, reliable=True, latched=latched)
        publisher = self._node.create_publisher(get_message(kind), topic, qos)
        self._closing.append(lambda: self._node.destroy_publisher(publisher))
        return publisher.publish

    def published(self) -> dict[str, set[str]]:
        """Topics with a publisher, and their types."""
        found = self._node.get_topic_names_and_types()
        return {topic: set(kinds) for topic, kinds in found if self._node.count_publishers(topic)}

    def close(self) -> None:
        """End the subscriptions and publishers. The node stays."""
        while self._closing:
            self._closing.pop()()

    def _taking(self, topic: str, kind: str, receive: Receive) -> Callable[[bytes], None]:
        def take(cdr: bytes) -> None:
            try:
                receive(Received(kind, bytes(cdr), None, time.monotonic()))
            except Exception as error:  # rclpy would end the node
                self._report(f"message {topic}", f"{topic}: expected a valid message, found {in_short(error)}")

        return take


def _qos(depth: int, *, reliable: bool, latched: bool) -> QoSProfile:
    return QoSProfile(
        depth=depth,
        history=HistoryPolicy.KEEP_LAST,
        reliability=ReliabilityPolicy.RELIABLE if reliable else ReliabilityPolicy.BEST_EFFORT,
        durability=DurabilityPolicy.TRANSIENT_LOCAL if latched else DurabilityPolicy.VOLATILE,
    )
