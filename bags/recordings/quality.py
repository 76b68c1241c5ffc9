"""Quality of service: what a topic's publishers offered when it was recorded.

rosbag2 keeps it twice, in metadata.yaml and in the channel of the MCAP file, and offers the same
when it plays the bag: a latched topic is latched again. rosbags reads a channel of a folder only
if both say the same. Until version 8 policies were numbers in a text of YAML, from version 9 (ROS
2 Jazzy) they are words in YAML of its own; both are read, and words are written.
"""

from collections.abc import Iterable
from enum import Enum
from functools import lru_cache
from typing import Any, Final, NamedTuple

import yaml
from rosbags.interfaces import QosDurability, QosHistory, QosLiveliness, QosReliability, QosTime

FOREVER: Final = QosTime(9223372036, 854775807)  # as ROS 2 writes it
MAX_TEXT: Final = 2**16  # characters; a topic with a hundred publishers has 30 000
KEY: Final = "offered_qos_profiles"  # in metadata.yaml, and of a channel's metadata
TYPE_HASH: Final = "topic_type_hash"  # of a channel's metadata, as rosbag2 writes it

# The C loader where PyYAML has it: ten thousand topics are seconds in Python.
LOADER: Final[Any] = getattr(yaml, "CSafeLoader", yaml.SafeLoader)


class Times(NamedTuple):
    """The times of a profile, by their names in rmw."""

    deadline: QosTime = FOREVER
    lifespan: QosTime = FOREVER
    liveliness_lease_duration: QosTime = FOREVER


class Profile(NamedTuple):
    """What one publisher offered, in the words of rmw."""

    history: str = "keep_last"
    depth: int = 10
    reliability: str = "reliable"
    durability: str = "volatile"
    times: Times = Times()
    liveliness: str = "automatic"
    avoid_ros_namespace_conventions: bool = False

    @property
    def latched(self) -> bool:
        """Whether a subscriber that comes later still gets the last messages."""
        return self.durability == "transient_local"

    def document(self) -> dict[str, Any]:
        """As metadata.yaml of version 9 says it."""
        return {
            "history": self.history,
            "depth": self.depth,
            "reliability": self.reliability,
            "durability": self.durability,
            "deadline": self.times.deadline._asdict(),
            "lifespan": self.times.lifespan._asdict(),
            "liveliness": self.liveliness,
            "liveliness_lease_duration": self.times.liveliness_lease_duration._asdict(),
            "avoid_ros_namespace_conventions": self.avoid_ros_namespace_conventions,
        }


LATCHED: Final = Profile(depth=1, durability="transient_local")  # a latched topic of ROS 1


def offered(found: object) -> tuple[Profile, ...]:
    """The profiles in a text of YAML, or in its parsed content; none where they are malformed.

    A bag without a quality of service plays with the player's own; so does one whose is damaged.
    """
    if isinstance(found, str):
        return _parsed(found) if len(found) <= MAX_TEXT else ()
    try:
        return tuple(dict.fromkeys(_profile(entry) for entry in found))  # type: ignore[attr-defined]
    except (TypeError, ValueError, KeyError, IndexError, AttributeError):
        return ()


def offered_text(profiles: Iterable[Profile]) -> str:
    """The profiles as the channel of an MCAP file holds them."""
    return yaml.safe_dump([profile.document() for profile in profiles], sort_keys=False)


def profile_of(qos: Any) -> Profile:
    """From rclpy's object."""
    return Profile(
        qos.history.name.lower(),
        int(qos.depth),
        qos.reliability.name.lower(),
        qos.durability.name.lower(),
        Times(*(QosTime(*divmod(getattr(qos, name).nanoseconds, 10**9)) for name in Times._fields)),
        qos.liveliness.name.lower(),
        bool(qos.avoid_ros_namespace_conventions),
    )


@lru_cache(maxsize=1024)
def _parsed(text: str) -> tuple[Profile, ...]:
    try:
        found = yaml.load(text, Loader=LOADER)
    except (yaml.YAMLError, ValueError, RecursionError):
        return ()
    return () if isinstance(found, str) else offered(found)


def _profile(entry: Any) -> Profile:
    depth = int(entry["depth"])
    if depth < 0:
        raise ValueError(f"depth {depth}")
    return Profile(
        _word(entry["history"], QosHistory),
        depth,
        _word(entry["reliability"], QosReliability),
        _word(entry["durability"], QosDurability),
        Times(*(_span(entry[name]) for name in Times._fields)),
        _word(entry["liveliness"], QosLiveliness),
        bool(entry["avoid_ros_namespace_conventions"]),
    )


def _word(found: object, policies: type[Enum]) -> str:
    """What a policy is called; in old bags it is its number, by rmw."""
    words = [policy.name.lower() for policy in policies]
    if isinstance(found, int) and 0 <= found < len(words):
        return words[found]
    word = str(found).lower()
    return word if word in words else "unknown"


def _span(found: Any) -> QosTime:
    span = QosTime(int(found["sec"]), int(found["nsec"]))
    if not (0 <= span.sec < 2**64 and 0 <= span.nsec < 2**64):
        raise ValueError(f"a time of {span}")
    return span
