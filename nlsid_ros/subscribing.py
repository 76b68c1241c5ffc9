"""Topics asked for by name or pattern, subscribed to as their publishers appear."""

import inspect
from collections import deque
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from fnmatch import fnmatchcase
from functools import partial
from typing import Any, NamedTuple

from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.node import Node
from rclpy.subscription import Subscription

from bags.recordings.definitions import Definition
from bags.recordings.quality import Profile, profile_of
from nlsid_core.errors import NlsidError
from nlsid_ros import qos
from nlsid_ros.message_classes import message_class
from nlsid_ros.type_descriptions import TypeDescriptions

Received = Callable[[bytes, dict[str, int]], None]
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


@dataclass
class Source:
    """A topic's serialised messages with what the middleware says of each, as they came.

    They wait, as many as its quality of service keeps, until there is a callback and `take`.
    """

    depth: int
    callback: Received | None = None
    subscription: Subscription | None = None
    begun: bool = False
    lost: int = 0
    _waiting: deque[tuple[bytes, dict[str, int]]] = field(default_factory=deque)

    __signature__ = inspect.signature(lambda _data, _info: None)  # rclpy asks it for how many

    def __call__(self, *arrived: Any) -> None:
        """Keep a message; rclpy 7.1.6's EventsExecutor hands both parts on as one tuple."""
        data, info = arrived[0] if len(arrived) == 1 else arrived
        if len(self._waiting) >= self.depth:
            self._waiting.popleft()
            self.lost += 1
        self._waiting.append((data, info))

    def lose(self, event: Any) -> None:
        """The middleware lost some; what it calls lost before the first came, nobody sent us."""
        if self.begun or self._waiting:
            self.lost += event.total_count_change

    def take(self) -> None:
        """Call back for every message that waits."""
        if self.callback is None:
            return
        while self._waiting:
            self.begun = True
            self.callback(*self._waiting.popleft())


class _Undefined(NamedTuple):
    source: Source
    msgtype: str
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
    """Call `look` and `take` now and then. problems: why a topic is not recorded as wanted."""

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
        source = self._sources[topic] = Source(profile.depth)
        source.subscription = self.node.create_subscription(
            kind,
            topic,
            source,
            profile,
            event_callbacks=SubscriptionEventCallbacks(
                message_lost=source.lose,
                incompatible_qos=partial(self._warn_of_unheard, topic),
                use_default_callbacks=False,
            ),
            raw=True,
        )
        self._undefined[topic] = _Undefined(
            source,
            msgtype,
            str(publishers[0].topic_type_hash),
            tuple(profile_of(publisher.qos_profile) for publisher in publishers),
        )

    def _define(self, topic: str) -> None:
        found = self._undefined[topic]
        try:
            definition = self.types.find(found.msgtype, found.type_hash)
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

    def _warn_of_unheard(self, topic: str, event: Any) -> None:
        """Publishers that offer less than is asked for."""
        count = event.total_count
        self.warnings[topic] = f"{count} publishers that came later offer less and are not heard"
        self.node.get_logger().warning(
            f"{topic}: {self.warnings[topic]}; start the recorder after them"
        )
