"""Subscriptions that follow their publishers: one topic's, and those of a recorder by pattern."""

import inspect
import time
from collections import deque
from collections.abc import Callable, Iterable, Mapping
from fnmatch import fnmatchcase
from typing import Any, NamedTuple, Protocol

from rclpy.node import Node
from rclpy.qos import QoSProfile
from rclpy.subscription import Subscription
from rclpy.topic_endpoint_info import TopicEndpointInfo

from bags.recordings.definitions import Definition
from bags.recordings.message_types import header_frames, header_stamp_ns
from bags.recordings.quality import Profile, profile_of
from bags.signals.timing import Sequence
from nlsid_core.errors import NlsidError
from nlsid_ros import graph, qos
from nlsid_ros.message_classes import definition_of, installed_types, message_class
from nlsid_ros.messages import off_clock

Received = Callable[[Any, dict[str, int]], None]
STREAMED = 10  # messages, after which a topic's pace is known
OVERDUE = 5.0  # times the longest time between two messages of a topic
SHARED = {"diagnostic_msgs/msg/DiagnosticArray", "visualization_msgs/msg/Marker"}  # by many nodes
UNASKED = {"/rosout", "/parameter_events"}  # every node has them; a pattern does not mean them


class Wanted(NamedTuple):
    """A topic or a pattern for topics; msgtype: its type, empty: that of the first publisher."""

    topic: str
    msgtype: str

    @classmethod
    def parse(cls, entry: str, namespace: str) -> "Wanted":
        """From `/topic`, `/topic:=package/msg/Type` or `/pattern*`; without the first slash it is
        in the namespace.
        """
        topic, _, msgtype = entry.partition(":=")
        whole = topic if topic.startswith("/") else f"{namespace.rstrip('/')}/{topic}"
        return cls(whole, msgtype)

    @property
    def is_pattern(self) -> bool:
        """Whether it stands for any topic that matches."""
        return "*" in self.topic or "?" in self.topic


class Informed:
    """Calls back with a message and with what the middleware says of it.

    rclpy 7.1.6's EventsExecutor hands both on as one tuple.
    """

    __signature__ = inspect.signature(lambda _message, _info: None)  # rclpy asks it for how many

    def __init__(self, callback: Received) -> None:
        self._callback = callback

    def __call__(self, *arrived: Any) -> None:
        """Call back."""
        message, info = arrived[0] if len(arrived) == 1 else arrived
        self._callback(message, info)


class Silence:
    """How long nothing came on a topic, beside how long that usually takes."""

    def __init__(self) -> None:
        self._since = time.monotonic()
        self._longest = 0.0
        self._count = 0

    def end(self, count: int) -> None:
        """Take note that so many messages came."""
        now = time.monotonic()
        if self._count:
            self._longest = max(self._longest, now - self._since)
        self._since = now
        self._count += count

    @property
    def is_odd(self) -> bool:
        """Whether nothing came for 2 s, and for longer than is usual.

        Of a topic that had a few messages nobody knows what is usual.
        """
        past = time.monotonic() - self._since
        if 0 < self._count < STREAMED:
            return False
        return past > max(graph.SILENT, OVERDUE * self._longest)


class Topic:
    """A topic's subscription, as its publishers offer it, and what its messages show.

    `callback` gets serialised messages: what a node needs of them is read where it is.

    publishers: those of the type that is subscribed to. silence, numbers: of its messages, noted by
    whoever hears them. frame: the one that its messages have to be in; None: that of the next.
    anew: which publisher made it be subscribed to anew.
    """

    def __init__(
        self,
        node: Node,
        name: str,
        callback: Received,
        profile: QoSProfile = qos.STREAM,
    ) -> None:
        self.name, self.profile, self.kind, self.anew = name, profile, "", ""
        self.publishers: list[TopicEndpointInfo] = []
        self.silence, self.numbers = Silence(), Sequence()
        self.frame: str | None = None
        self._node, self._callback = node, Informed(callback)
        self._subscription: Subscription | None = None

    def look(self, kind: str, found: list[TopicEndpointInfo] | None = None) -> None:
        """Subscribe with this type, and anew where it or what its publishers offer has changed.

        found: the topic's publishers, if they are known. Raises BagError if there is no such type.
        """
        if found is None:
            found = self._node.get_publishers_info_by_topic(self.name)
        self.publishers = [each for each in found if each.topic_type == kind]
        wanted = qos.following(self.profile, [each.qos_profile for each in self.publishers])
        if self._subscription is not None:
            if (kind, wanted) == (self.kind, self.profile):
                return
            self._say_anew()
            self._node.destroy_subscription(self._subscription)
        else:
            self.silence = Silence()
        self._subscription = self._node.create_subscription(
            message_class(kind), self.name, self._callback, wanted, raw=True
        )
        self.kind, self.profile = kind, wanted

    def drop(self) -> None:
        """Unsubscribe."""
        if self._subscription is not None:
            self._node.destroy_subscription(self._subscription)

    @property
    def several(self) -> str:
        """Why nobody knows whose messages come: there are several publishers; else empty."""
        return graph.several(self.name, self.publishers)

    @property
    def unheard(self) -> str:
        """Who publishes without being heard, for longer than is usual; else empty."""
        return graph.unheard(self.name, self.publishers) if self.silence.is_odd else ""

    @property
    def alternating(self) -> str:
        """Whether the messages' numbers are those of several publishers, in turn; else empty."""
        turns = self.numbers.alternates
        return f"messages of several publishers come in turn on {self.name}" if turns else ""

    def distrust(self, data: bytes, clock_ns: int, most: float) -> str:
        """Why a response is not to be trusted though its number could be; empty if it is.

        most: s that its stamp may be off the node's clock, which is at `clock_ns`. Raises BagError
        if it has no header.
        """
        frame = header_frames(data, self.kind, installed_types(self.kind))
        if self.frame is None:
            self.frame = frame
        if frame != self.frame:
            return f"the response is in frame '{frame}', not in '{self.frame}'"
        return off_clock(header_stamp_ns(data), clock_ns, most)

    def _say_anew(self) -> None:
        self.anew = "; ".join(
            f"{self.name}: {graph.names([publisher])} came later and offers less ({why}): "
            "subscribed to anew"
            for publisher in self.publishers
            if (why := graph.mismatch(publisher.qos_profile, self.profile))
        )
        said = f"{self.name} is subscribed to anew, as {graph.names(self.publishers)} offers it"
        self._node.get_logger().warning(self.anew or said)


class Recording(Protocol):
    """What becomes of a recorder's topics."""

    def expect(self, topic: str) -> None:
        """A topic is to be recorded, as soon as somebody publishes it."""

    def begin(self, topic: str, definition: Definition, offered: tuple[Profile, ...]) -> Received:
        """A topic's type is known, and what its publishers offered; what takes its messages."""


class Source:
    """A topic's serialised messages with what the middleware says of each, as they came.

    They wait until `take`, as many as the topic's quality of service keeps; those that did not wait
    are missing in the publisher's count of what it sent.

    The middleware's own event of lost messages is not asked for: rclpy takes it under a lock that
    Fast DDS holds while it tells of the next one, and both wait for ever.
    """

    def __init__(
        self, node: Node, name: str, msgtype: str, publishers: list[TopicEndpointInfo]
    ) -> None:
        self.topic = Topic(node, name, self._keep, qos.RECORDED)
        self.topic.look(msgtype, publishers)
        self._waiting: deque[tuple[bytes, dict[str, int]]] = deque()

    def _keep(self, data: bytes, info: dict[str, int]) -> None:
        """Keep a message until `take`."""
        if len(self._waiting) >= self.topic.profile.depth:
            self._waiting.popleft()
        self._waiting.append((data, info))

    def take(self, received: Received) -> None:
        """Hand on every message that waits."""
        if self._waiting:
            self.topic.silence.end(len(self._waiting))
        while self._waiting:
            received(*self._waiting.popleft())

    def odd(self) -> str:
        """Ask for what the publishers offer now; what is odd about them."""
        self.topic.look(self.topic.kind)
        said = [self.topic.anew, self.topic.unheard]
        if _has_one_publisher(self.topic.kind):
            said.append(self.topic.several)
        return "; ".join(filter(None, said))


class Subscriptions:
    """Call `look` and `take` now and then, `follow` about every second.

    given: definitions of types. problems: why a topic is not recorded as wanted. warnings: what is
    odd about one that is.
    """

    def __init__(
        self,
        node: Node,
        given: Mapping[str, Definition],
        recording: Recording,
        wanted: Iterable[Wanted],
    ) -> None:
        self.problems: dict[str, str] = {}
        self.warnings: dict[str, str] = {}
        self._node, self._given, self._recording = node, given, recording
        self._patterns = [each.topic for each in wanted if each.is_pattern]
        self._waiting: dict[str, str] = {}
        self._sources: dict[str, Source] = {}
        self._received: dict[str, Received] = {}
        self._known = set(UNASKED)
        for each in wanted:
            if not each.is_pattern:
                self._expect(each.topic, each.msgtype)

    def look(self) -> None:
        """Subscribe to topics that have publishers now."""
        for topic, _ in self._node.get_topic_names_and_types() if self._patterns else ():
            if topic not in self._known and any(fnmatchcase(topic, p) for p in self._patterns):
                self._expect(topic, "")
        for topic in list(self._waiting):
            if publishers := self._node.get_publishers_info_by_topic(topic):
                self._attempt(topic, publishers)

    def take(self) -> None:
        """Hand on what has come."""
        for topic, source in self._sources.items():
            source.take(self._received[topic])

    def follow(self) -> None:
        """Ask for what the publishers offer now, and say what is odd about a topic."""
        said = {topic: source.odd() for topic, source in self._sources.items()}
        self.warnings = {topic: text for topic, text in said.items() if text}

    def drop_all(self) -> None:
        """Unsubscribe from everything."""
        for source in self._sources.values():
            source.topic.drop()
        self._sources.clear()

    def _expect(self, topic: str, msgtype: str) -> None:
        self._waiting[topic] = msgtype
        self._known.add(topic)
        self._recording.expect(topic)

    def _attempt(self, topic: str, publishers: list[TopicEndpointInfo]) -> None:
        """Subscribe to a topic, or give up recording it, and say why."""
        msgtype = self._waiting.pop(topic) or publishers[0].topic_type
        try:
            self._sources[topic] = Source(self._node, topic, msgtype, publishers)
            kind = definition_of(msgtype, str(publishers[0].topic_type_hash), self._given)
            offered = tuple(profile_of(each.qos_profile) for each in publishers)
            self._received[topic] = self._recording.begin(topic, kind, offered)
        except NlsidError as error:
            if topic in self._sources:
                self._sources.pop(topic).topic.drop()
            self.problems[topic] = str(error)
            self._node.get_logger().error(f"{topic} is not recorded: {error}")


def _has_one_publisher(kind: str) -> bool:
    """Whether a topic is one robot's signal: stamped, and not of a kind that many nodes share."""
    return kind not in SHARED and "header" in message_class(kind).get_fields_and_field_types()
