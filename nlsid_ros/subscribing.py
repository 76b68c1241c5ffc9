"""Topics asked for by name or pattern, subscribed to as their publishers appear."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from fnmatch import fnmatchcase
from functools import partial
from typing import NamedTuple

from rclpy.node import Node

from bags.recordings.definitions import Definition
from bags.recordings.quality import Profile, profile_of
from nlsid_core.errors import NlsidError
from nlsid_ros import qos
from nlsid_ros.message_classes import message_class
from nlsid_ros.polling import Polled, Received, Source
from nlsid_ros.type_descriptions import TypeDescriptions

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
    """Call `look` now and then. problems: why a topic is not recorded, or not all of it."""

    node: Node
    polled: Polled
    types: TypeDescriptions
    listener: Listener
    problems: dict[str, str] = field(default_factory=dict)
    warnings: dict[str, str] = field(default_factory=dict)
    _waiting: dict[str, str] = field(default_factory=dict)
    _patterns: list[str] = field(default_factory=list)
    _undefined: dict[str, _Undefined] = field(default_factory=dict)
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
        source = self.polled.subscribe(
            kind,
            topic,
            qos.recording_of([publisher.qos_profile for publisher in publishers]),
            on_lost=partial(self.listener.lose, topic),
            on_incompatible=partial(self._warn_of_unheard, topic),
        )
        self._undefined[topic] = _Undefined(
            source,
            msgtype,
            str(publishers[0].topic_type_hash),
            tuple(profile_of(publisher.qos_profile) for publisher in publishers),
        )

    def _define(self, topic: str) -> None:
        """What has come meanwhile waits in the middleware."""
        found = self._undefined[topic]
        try:
            definition = self.types.find(found.msgtype, found.type_hash)
            if definition is None:
                return
            found.source.callback = self.listener.begin(topic, definition, found.offered)
        except NlsidError as error:
            self.polled.drop(found.source)
            self._refuse(topic, error)
        del self._undefined[topic]

    def _refuse(self, topic: str, error: NlsidError) -> None:
        self.problems[topic] = str(error)
        self.node.get_logger().error(f"{topic} is not recorded: {error}")

    def _warn_of_unheard(self, topic: str, count: int) -> None:
        self.warnings[topic] = f"{count} publishers that came later offer less and are not heard"
        self.node.get_logger().warning(
            f"{topic}: {self.warnings[topic]}; start the recorder after them"
        )
