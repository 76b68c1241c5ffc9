"""Topics asked for by name or pattern, subscribed to as their publishers appear."""

import inspect
import time
from collections import deque
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from fnmatch import fnmatchcase
from typing import Any, NamedTuple

from rclpy.node import Node
from rclpy.qos import QoSProfile
from rclpy.subscription import Subscription
from rclpy.topic_endpoint_info import TopicEndpointInfo

from bags.recordings.definitions import Definition
from bags.recordings.quality import Profile, profile_of
from nlsid_core.errors import NlsidError
from nlsid_ros import graph, qos
from nlsid_ros.message_classes import message_class
from nlsid_ros.type_descriptions import TypeDescriptions

Received = Callable[[bytes, dict[str, int]], None]
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

    def __init__(self, callback: Callable[[Any, dict[str, int]], None]) -> None:
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


@dataclass
class Source:
    """A topic's serialised messages with what the middleware says of each, as they came.

    They wait, as many as its quality of service keeps, until there is a callback and `take`.

    lost: those that did not wait until the callback was there; later ones are missing in the
    publisher's count of what it sent. followed: why it was subscribed to anew.

    The middleware's own event of lost messages is not asked for: rclpy takes it under a lock that
    Fast DDS holds while it tells of the next one, and both wait for ever.
    """

    msgtype: str
    profile: QoSProfile
    callback: Received | None = None
    subscription: Subscription | None = None
    lost: int = 0
    followed: str = ""
    _waiting: deque[tuple[bytes, dict[str, int]]] = field(default_factory=deque)
    silence: Silence = field(default_factory=Silence)

    def keep(self, data: bytes, info: dict[str, int]) -> None:
        """Keep a message until `take`."""
        if len(self._waiting) >= self.profile.depth:
            self._waiting.popleft()
            self.lost += self.callback is None
        self._waiting.append((data, info))

    def take(self) -> None:
        """Call back for every message that waits."""
        if self._waiting:
            self.silence.end(len(self._waiting))
        if self.callback is None:
            return
        while self._waiting:
            self.callback(*self._waiting.popleft())


class _Undefined(NamedTuple):
    source: Source
    type_hash: str
    offered: tuple[Profile, ...]


@dataclass
class Listener:
    """What becomes of the topics: all called with the topic's name first."""

    expect: Callable[[str], None]
    begin: Callable[[str, Definition, tuple[Profile, ...]], Received]
    lose: Callable[[str, int], None]


@dataclass
class Subscriptions:
    """Call `look` and `take` now and then, `follow` about every second.

    problems: why a topic is not recorded as wanted. warnings: what is odd about one that is.
    """

    node: Node
    types: TypeDescriptions
    listener: Listener
    problems: dict[str, str] = field(default_factory=dict)
    warnings: dict[str, str] = field(default_factory=dict)
    _waiting: dict[str, str] = field(default_factory=dict)
    _patterns: list[str] = field(default_factory=list)
    _undefined: dict[str, _Undefined] = field(default_factory=dict)
    _sources: dict[str, Source] = field(default_factory=dict)
    _known: set[str] = field(default_factory=lambda: set(UNASKED))

    def want(self, wanted: Iterable[Wanted]) -> None:
        """Wait for these."""
        for each in wanted:
            if each.is_pattern:
                self._patterns.append(each.topic)
            else:
                self._expect(each.topic, each.msgtype)

    def look(self) -> None:
        """Subscribe to topics that have publishers now; begin those whose type is defined."""
        for topic, _ in self.node.get_topic_names_and_types() if self._patterns else ():
            if topic not in self._known and any(fnmatchcase(topic, p) for p in self._patterns):
                self._expect(topic, "")
        for topic in list(self._waiting):
            self._subscribe(topic)
        for topic in list(self._undefined):
            self._define(topic)

    def take(self) -> None:
        """Hand on what has come."""
        for topic, source in self._sources.items():
            source.take()
            if source.lost:
                self.listener.lose(topic, source.lost)
                source.lost = 0

    def follow(self) -> None:
        """Ask for what the publishers offer now, and say what is odd about a topic."""
        self.warnings.clear()
        for topic, source in self._sources.items():
            publishers = [
                publisher
                for publisher in self.node.get_publishers_info_by_topic(topic)
                if publisher.topic_type == source.msgtype
            ]
            self._match(topic, source, publishers)
            said = [source.followed]
            if source.silence.is_odd:
                said.append(graph.unheard(topic, publishers))
            if _has_one_publisher(source):
                said.append(graph.several(topic, publishers))
            if text := "; ".join(filter(None, said)):
                self.warnings[topic] = text

    def _match(self, topic: str, source: Source, publishers: list[TopicEndpointInfo]) -> None:
        """Subscribe anew where the quality of service is not what the publishers offer now."""
        assert source.subscription is not None
        wanted = qos.following(source.profile, [p.qos_profile for p in publishers])
        if not publishers or wanted == source.profile:
            return
        source.followed = "; ".join(
            f"{topic}: {graph.names([publisher])} came later and offers less ({why}): subscribed "
            "to anew"
            for publisher in publishers
            if (why := graph.mismatch(publisher.qos_profile, source.profile))
        )
        self.node.get_logger().warning(source.followed or f"{topic} is subscribed to anew")
        kind = source.subscription.msg_type
        self.node.destroy_subscription(source.subscription)
        source.profile = wanted
        source.subscription = self.node.create_subscription(
            kind, topic, Informed(source.keep), wanted, raw=True
        )

    def drop_all(self) -> None:
        """Unsubscribe from everything."""
        for topic in list(self._sources):
            self._drop(topic)

    def _drop(self, topic: str) -> None:
        subscription = self._sources.pop(topic).subscription
        if subscription is not None:
            self.node.destroy_subscription(subscription)

    def _expect(self, topic: str, msgtype: str) -> None:
        self._waiting[topic] = msgtype
        self._known.add(topic)
        self.listener.expect(topic)

    def _subscribe(self, topic: str) -> None:
        publishers = self.node.get_publishers_info_by_topic(topic)
        if not publishers:
            return
        msgtype = self._waiting.pop(topic) or publishers[0].topic_type
        try:
            kind = message_class(msgtype)
        except NlsidError as error:
            self._refuse(topic, error)
            return
        profile = qos.recording_of([publisher.qos_profile for publisher in publishers])
        source = self._sources[topic] = Source(msgtype, profile)
        source.subscription = self.node.create_subscription(
            kind, topic, Informed(source.keep), profile, raw=True
        )
        self._undefined[topic] = _Undefined(
            source,
            str(publishers[0].topic_type_hash),
            tuple(profile_of(publisher.qos_profile) for publisher in publishers),
        )

    def _define(self, topic: str) -> None:
        found = self._undefined[topic]
        try:
            definition = self.types.find(found.source.msgtype, found.type_hash)
            if definition is None:
                return
            found.source.callback = self.listener.begin(topic, definition, found.offered)
        except NlsidError as error:
            self._drop(topic)
            self._refuse(topic, error)
        del self._undefined[topic]

    def _refuse(self, topic: str, error: NlsidError) -> None:
        self.problems[topic] = str(error)
        self.node.get_logger().error(f"{topic} is not recorded: {error}")


def _has_one_publisher(source: Source) -> bool:
    """Whether the topic is one robot's signal: stamped, and not of a kind that many nodes share."""
    assert source.subscription is not None
    kind: Any = source.subscription.msg_type
    fields = kind.get_fields_and_field_types()
    return "header" in fields and source.msgtype not in SHARED
