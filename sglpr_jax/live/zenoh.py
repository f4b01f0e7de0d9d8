"""Connection to ROS 2 by zenoh, without an installation of ROS (eclipse-zenoh, extra `live`).

Keys, attachments and liveliness tokens follow rmw_zenoh from its release for Jazzy 0.2.4:

* A message of `/points` in domain 0 has the key `0/points/sensor_msgs::msg::dds_::PointCloud2_/RIHS01_...`. The last
  part is a hash of the type (REP 2011). rosbags computes it. Our subscriptions accept any hash. A publisher reaches
  only subscribers with the same hash: not nodes of Humble, whose keys have the text `TypeHashNotSupported` instead.
* The attachment is sequence number and time in nanoseconds (int64), and 16 bytes that identify the publisher.
* A token `@ros2_lv/DOMAIN/SESSION/NODE_NAME/ID/MP/...` exists while a publisher lives.

The hashes of PointCloud2 and TFMessage were compared with published ones.
"""

import json
import os
import secrets
import time
from collections.abc import Callable, Collection
from typing import Any

import zenoh
from zenoh.ext import (
    CacheConfig,
    HistoryConfig,
    Int64,
    declare_advanced_publisher,
    declare_advanced_subscriber,
    z_serialize,
)

from sglpr_jax.files import in_short
from sglpr_jax.live.data_types import Report
from sglpr_jax.live.ros_encoding import Received, typestore
from sglpr_jax.live.ros_topics import Receive, domain_of, ros_type, wire_type

DEFAULT_ROUTER = "tcp/localhost:7447"
"""Endpoint of rmw_zenoh's router."""
NODE_NAME = "sglpr"
"""Name of this node in ROS 2."""
GID_BYTES = 16
"""Length of the identifier of a publisher, at the end of an attachment."""
ANSWER_S = 1.0
"""Maximum time for answers about publishers, in seconds."""


class ZenohTransport:
    """Connection by a zenoh session. See `ros_topics.Transport` for the methods."""

    def __init__(self, endpoint: str, domain: int, report: Report):
        """Open a session. Raises ValueError if the endpoint or the configuration is invalid. `endpoint` is that of a
        router or peer, such as `tcp/192.168.0.2:7447`. If it is empty, the file that ZENOH_SESSION_CONFIG_URI names
        configures the session, or else it uses rmw_zenoh's router on this computer."""
        self._domain, self._report = domain, report
        try:
            self._session = zenoh.open(_session_config(endpoint))
        except (zenoh.ZError, OSError) as error:
            where = endpoint or os.environ.get("ZENOH_SESSION_CONFIG_URI") or DEFAULT_ROUTER
            raise ValueError(
                f"zenoh: expected a valid endpoint or configuration, found {where} ({in_short(error)})"
            ) from error
        self._declared: list[Any] = [self._declare_token("NN", 0)]

    def subscribe(
        self, topic: str, kinds: Collection[str], receive: Receive, *, depth: int, reliable: bool, latched: bool
    ) -> None:
        """See `Transport`. `reliable` has no effect, because zenoh has no such setting of a subscriber."""

        def take(sample: zenoh.Sample) -> None:
            """Pass a message to `receive`. The type is the last but one part of its key."""
            try:
                kind = ros_type(str(sample.key_expr).split("/")[-2])
                if kind in kinds and sample.kind == zenoh.SampleKind.PUT:
                    publisher = b"" if sample.attachment is None else sample.attachment.to_bytes()[-GID_BYTES:]
                    receive(Received(kind, sample.payload.to_bytes(), publisher, time.monotonic()))
            except Exception as error:  # zenoh would only print it
                self._report(f"message {topic}", f"{topic}: expected a valid message, found {in_short(error)}")

        key = f"{self._domain}{topic}/*/*"
        if latched:
            history = HistoryConfig(detect_late_publishers=True, max_samples=depth)
            self._declared.append(declare_advanced_subscriber(self._session, key, take, history=history))
        else:
            self._declared.append(self._session.declare_subscriber(key, take))

    def advertise(self, topic: str, kind: str, *, depth: int, latched: bool) -> Callable[[bytes], None]:
        """See `Transport`."""
        type_hash = typestore().hash_rihs01(kind)
        key = f"{self._domain}{topic}/{wire_type(kind)}/{type_hash}"
        drop = zenoh.CongestionControl.DROP
        if latched:
            publisher: Any = declare_advanced_publisher(
                self._session, key, congestion_control=drop, cache=CacheConfig(depth), publisher_detection=True
            )
        else:
            publisher = self._session.declare_publisher(key, congestion_control=drop)
        name = topic.replace("/", "%")
        # QoS of rmw_zenoh: reliability, durability (1: transient local), history and depth, ... Empty is the default.
        qos = f":{1 if latched else ''}:,{depth}:,:,:,,"
        token = self._declare_token("MP", len(self._declared), f"/{name}/{wire_type(kind)}/{type_hash}/{qos}")
        self._declared += [publisher, token]
        publisher_id, messages_sent = secrets.token_bytes(GID_BYTES), 0

        def publish(cdr: bytes) -> None:
            """Publish a message with the attachment of rmw_zenoh: number, time and publisher."""
            nonlocal messages_sent
            messages_sent += 1
            publisher.put(cdr, attachment=z_serialize((Int64(messages_sent), Int64(time.time_ns()), publisher_id)))

        return publish

    def published(self) -> dict[str, set[str]]:
        """See `Transport`. Asks for the tokens of publishers, whose keys end with topic, type, hash and QoS."""
        topics: dict[str, set[str]] = {}
        for reply in self._session.liveliness().get(f"@ros2_lv/{self._domain}/*/*/*/MP/**", timeout=ANSWER_S):
            if reply.ok is not None:
                *_, topic, kind, _, _ = str(reply.ok.key_expr).split("/")
                topics.setdefault(topic.replace("%", "/"), set()).add(ros_type(kind))
        return topics

    def close(self) -> None:
        for entity in self._declared:
            entity.undeclare()
        self._session.close()

    def _declare_token(self, entity: str, number: int, topic: str = "") -> Any:
        """Declare a liveliness token of the node (NN) or of a publisher (MP)."""
        key = f"@ros2_lv/{self._domain}/{self._session.zid()}/0/{number}/{entity}/%/%/{NODE_NAME}{topic}"
        return self._session.liveliness().declare_token(key)


def _session_config(endpoint: str) -> zenoh.Config:
    """Return the configuration of a session. It is the file that ZENOH_SESSION_CONFIG_URI names. With an endpoint, or
    without a file, it is that of a peer that finds others by a router, as rmw_zenoh's."""
    file = "" if endpoint else os.environ.get("ZENOH_SESSION_CONFIG_URI")
    config = zenoh.Config.from_file(file) if file else zenoh.Config()
    settings: dict[str, Any] = {"timestamping/enabled": True}  # publishers with a cache need timestamps
    if not file:
        settings |= {
            "mode": "peer",
            "connect/endpoints": [endpoint or DEFAULT_ROUTER],
            "listen/endpoints": ["tcp/localhost:0"],
            "scouting/multicast/enabled": False,
            "scouting/gossip/enabled": True,
        }
    for key, value in settings.items():
        config.insert_json5(key, json.dumps(value))
    return config


def open_transport(where: str, report: Report) -> ZenohTransport:
    """Connect to the endpoint `where`, such as tcp/localhost:7447. Raises the errors of `ZenohTransport`."""
    return ZenohTransport(where, domain_of("", source="zenoh"), report)
