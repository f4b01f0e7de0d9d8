"""Connection to ROS 2 by DDS, without an installation of ROS (cyclonedds, extra `live`).

Names are those of rmw_cyclonedds and rmw_fastrtps: a topic `/points` is `rt/points` on the wire, and a type has a name
such as `sensor_msgs::msg::dds_::PointCloud2_`. Types are declared with the fields of ROS 2 and as final, like the type
information of newer releases of rmw_cyclonedds. Messages stay encoded (CDR, XCDR1).
"""

import contextlib
import functools
import os
import threading
import time
from collections.abc import Callable, Collection, Iterator
from typing import Any

from cyclonedds.builtin import BuiltinDataReader, BuiltinTopicDcpsPublication
from cyclonedds.core import DDSException, InstanceState, Policy, Qos, ReadCondition, SampleState, ViewState, WaitSet
from cyclonedds.domain import Domain, DomainParticipant
from cyclonedds.idl import make_idl_struct, types
from cyclonedds.pub import DataWriter
from cyclonedds.sub import DataReader
from cyclonedds.topic import Topic
from cyclonedds.util import duration

from sglpr_jax.files import in_short
from sglpr_jax.live.data_types import Report
from sglpr_jax.live.ros_encoding import Received, typestore
from sglpr_jax.live.ros_topics import Receive, domain_of, ros_type, wire_type

TOPIC_PREFIX = "rt"
"""Beginning of the names of ROS 2 topics on the wire. Services have others."""
QOS_CHECK_S = 1.0
"""Time between two checks for publishers and subscribers whose QoS does not fit, in seconds."""
RECEIVE_BUFFER = '<CycloneDDS><Domain><Internal><SocketReceiveBufferSize max="16MB"/></Internal></Domain></CycloneDDS>'
"""Setting of cyclonedds. A scan of 2 MB arrives as a burst of packets, and the usual buffer of 1 MB loses many of them.
The system may set a lower limit (`net.core.rmem_max`)."""
POLICIES = {2: "durability", 4: "deadline", 8: "liveliness", 10: "partition", 11: "reliability", 23: "representation"}
"""Names of QoS policies, by their numbers in the standard."""
TYPE_POLICY = 24
"""Number of the policy on types. Mismatches of types are not reported here, because `RosSource` reports them."""
_BASE_TYPES = {"bool": bool, "byte": types.uint8, "octet": types.uint8, "char": types.uint8, "string": str} | {
    name: getattr(types, name)
    for name in ("float32", "float64", *(f"{sign}int{bits}" for sign in ("", "u") for bits in (8, 16, 32, 64)))
}


class DdsTransport:
    """Participant of a DDS domain. A thread takes the messages. See `ros_topics.Transport`."""

    def __init__(self, domain: int, report: Report):
        """Join a domain. CYCLONEDDS_URI in the environment configures cyclonedds, as for ROS 2. Raises ValueError if
        cyclonedds cannot use the network or this configuration."""
        self._report = report
        _configure(domain)
        try:
            self._participant = DomainParticipant(domain)
        except DDSException as error:
            setting = os.environ.get("CYCLONEDDS_URI", "no CYCLONEDDS_URI")
            raise ValueError(
                f"dds:{domain}: expected a network and a valid CYCLONEDDS_URI, found {setting} ({in_short(error)})"
            ) from error
        self._publications = BuiltinDataReader(self._participant, BuiltinTopicDcpsPublication)
        self._waiting = WaitSet(self._participant)
        self._topics: dict[tuple[str, str], Topic] = {}
        self._deliveries: list[Callable[[], None]] = []
        """Functions that pass the new messages of a reader to its `receive`."""
        self._writers: dict[tuple[str, str], DataWriter] = {}
        self._qos_statuses: dict[str, Callable[[], Any]] = {}
        """Function that returns the status of the QoS mismatches of a topic, by their report."""
        self._closed = threading.Event()
        self._thread = threading.Thread(target=self._run, name="dds", daemon=True)
        self._thread.start()

    def subscribe(
        self, topic: str, kinds: Collection[str], receive: Receive, *, depth: int, reliable: bool, latched: bool
    ) -> None:
        qos = _qos(depth, reliable=reliable, latched=latched)
        mismatch = f"{topic}: expected a publisher with the QoS {_qos_text(reliable, latched)}, found one without"
        for kind in kinds:
            reader = DataReader(self._participant, self._topic(topic, kind), qos=qos)
            condition = ReadCondition(reader, ViewState.Any | InstanceState.Any | SampleState.NotRead)
            self._deliveries.append(functools.partial(self._deliver, kind, reader, condition, receive, depth))
            self._waiting.attach(condition)
        self._qos_statuses[mismatch] = reader.get_requested_incompatible_qos_status  # one for all types

    def advertise(self, topic: str, kind: str, *, depth: int, latched: bool) -> Callable[[bytes], None]:
        qos = _qos(depth, reliable=True, latched=latched)
        writer = DataWriter(self._participant, self._topic(topic, kind), qos=qos)
        expected = f"{topic}: expected subscribers that accept the QoS {_qos_text(True, latched)}"
        mismatch = f"{expected}, found one that asks for more"
        self._qos_statuses[mismatch] = writer.get_offered_incompatible_qos_status
        self._writers[topic, kind] = writer
        del writer  # held by the dictionary alone, so that `close` deletes it

        def publish(cdr: bytes) -> None:
            try:
                self._writers[topic, kind].write(_raw_type(kind)(cdr), timestamp=time.time_ns())
            except DDSException as error:  # a slow subscriber
                self._report(f"publish {topic}", f"{topic}: cannot publish a message ({in_short(error)})")

        return publish

    def published(self) -> dict[str, set[str]]:
        topics: dict[str, set[str]] = {}
        for publication in self._publications.read(N=10_000):
            name, kind = publication.topic_name, publication.type_name
            alive = publication.sample_info.instance_state == InstanceState.Alive
            if alive and name is not None and kind is not None and name.startswith(f"{TOPIC_PREFIX}/"):
                topics.setdefault(name.removeprefix(TOPIC_PREFIX), set()).add(ros_type(kind))
        return topics

    def close(self) -> None:
        self._closed.set()
        self._thread.join()
        for entities in (self._qos_statuses, self._deliveries, self._writers, self._topics):
            entities.clear()
        del self._waiting, self._publications, self._participant

    def _topic(self, topic: str, kind: str) -> Topic:
        if (topic, kind) not in self._topics:
            self._topics[topic, kind] = Topic(self._participant, f"{TOPIC_PREFIX}{topic}", _raw_type(kind))
        return self._topics[topic, kind]

    def _run(self) -> None:
        """Deliver messages, and check the QoS regularly, until the transport is closed. Runs in its own thread."""
        checked_at = time.monotonic()
        while not self._closed.is_set():
            if self._deliveries:
                self._waiting.wait(duration(milliseconds=100))
            else:  # without readers, the wait of cyclonedds returns at once, and this loop would use a core
                self._closed.wait(0.1)
            for deliver in tuple(self._deliveries):
                deliver()
            if time.monotonic() - checked_at > QOS_CHECK_S:
                checked_at = time.monotonic()
                self._report_qos_mismatches()

    def _deliver(self, kind: str, reader: DataReader, condition: ReadCondition, receive: Receive, depth: int) -> None:
        """Pass the new messages of a reader to `receive`, at most `depth` of them."""
        samples = list[Any]()
        with self._reporting(kind):
            samples = reader.take(N=depth, condition=condition)
        for sample in samples:
            with self._reporting(kind):
                if sample.sample_info.valid_data:
                    publisher = sample.sample_info.publication_handle
                    receive(Received(kind, sample.cdr, publisher, time.monotonic()))

    @contextlib.contextmanager
    def _reporting(self, kind: str) -> Iterator[None]:
        """Report an error, which loses one message. It must not end the thread, which serves the other topics, too."""
        try:
            yield
        except Exception as error:  # whatever a message holds
            self._report(f"message {kind}", f"{kind}: expected a valid message, found {in_short(error)}")

    def _report_qos_mismatches(self) -> None:
        """Report each new publisher or subscriber whose QoS does not fit."""
        for text, qos_status in tuple(self._qos_statuses.items()):
            mismatch = qos_status()
            if mismatch.total_count_change > 0 and mismatch.last_policy_id != TYPE_POLICY:
                policy = POLICIES.get(mismatch.last_policy_id, f"policy {mismatch.last_policy_id}")
                self._report(f"qos {text}", f"{text} ({policy}); they do not exchange messages")


@functools.cache
def _configure(domain: int) -> Domain | None:
    """Configure a domain, once in a process, with `RECEIVE_BUFFER`. CYCLONEDDS_URI overrides it. Returns None if
    another part of the process uses the domain already."""
    try:
        return Domain(domain, ",".join(filter(None, (RECEIVE_BUFFER, os.environ.get("CYCLONEDDS_URI")))))
    except DDSException:
        return None


def _qos(depth: int, *, reliable: bool, latched: bool) -> Qos:
    """Return the QoS of a reader or writer. See `ros_topics.Transport.subscribe` for the arguments."""
    return Qos(
        Policy.Reliability.Reliable(duration(milliseconds=100)) if reliable else Policy.Reliability.BestEffort,
        Policy.Durability.TransientLocal if latched else Policy.Durability.Volatile,
        Policy.History.KeepLast(depth),
        Policy.DurabilityService(duration(seconds=0), Policy.History.KeepLast(depth), -1, -1, -1),
        Policy.DataRepresentation(use_cdrv0_representation=True),
    )


def _qos_text(reliable: bool, latched: bool) -> str:
    """Return reliability and durability as ROS 2 names them."""
    return f"{'reliable' if reliable else 'best effort'}, {'transient local' if latched else 'volatile'}"


@functools.cache
def _raw_type(kind: str) -> Any:
    """Return the type of a ROS 2 message for cyclonedds, whose objects hold only the encoded message, as `cdr`. Other
    participants see the type with its fields. cyclonedds calls the four methods that are replaced here."""

    def init(self: Any, cdr: bytes) -> None:
        self.cdr = cdr

    def serialize(self: Any, **_: Any) -> bytes:
        return self.cdr

    def deserialize(cls: Any, cdr: bytes) -> Any:
        return cls(cdr)

    raw_type = _ros_struct.__wrapped__(kind)  # not the cached type, because it is changed
    raw_type.__init__ = init
    raw_type.serialize = serialize
    raw_type.deserialize = classmethod(deserialize)
    raw_type.deserialize_key = classmethod(deserialize)  # for the message that a publisher has ended
    return raw_type


@functools.cache
def _ros_struct(kind: str) -> Any:
    """Return the type of a ROS 2 message for cyclonedds, with the fields that rosbags defines."""

    def field_type(node: Any, definition: Any) -> Any:
        """Return the type of a field: a base type, the type of a message, or an array or sequence of a type."""
        if node.name == "BASE":
            return _BASE_TYPES[definition[0]]
        if node.name == "NAME":
            return _ros_struct(definition)
        element, count = definition
        if node.name == "ARRAY":
            return types.array[field_type(*element), count]
        return types.sequence[field_type(*element)]

    name = wire_type(kind).replace("::", ".")
    fields = {field: field_type(*definition) for field, definition in typestore().fielddefs[kind][1]}
    return make_idl_struct(name.rpartition(".")[2], name, fields, dataclassify=False)


def open_transport(where: str, report: Report) -> DdsTransport:
    """Connect to the domain `where`, by default ROS_DOMAIN_ID or 0. Raises ValueError if it is not from 0 to 232."""
    return DdsTransport(domain_of(where, source="dds"), report)
