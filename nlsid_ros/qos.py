"""The quality of service of every topic, and why.

DOCUMENT: a funnel, model or policy. Latched (transient local), so that a monitor that starts later
still gets it; one is enough, the newest counts.
STREAM: signals and margins. Reliable, because a lost sample ends a monitor's run, and deep enough
for five seconds at 1 kHz, so that a busy subscriber catches up. A reliable subscription does not
match a best-effort publisher: `subscription_to` matches what the publisher offers.
SENSOR: the response a controller acts on. Best effort matches every publisher, and an old sample
sent again would be too late to act on.
EVENTS: diagnostics. Reliable; a few pending are enough.
`command`: what a robot acts on. Reliable, and the newest only: an older one must not act after it.
Its deadline lets a base ask for commands in time, and hear from DDS when they are not.
"""

from rclpy.duration import Duration
from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy

from bags.recordings.quality import Profile

LEAST_DEADLINE = 0.05  # s
DOCUMENT = QoSProfile(
    history=HistoryPolicy.KEEP_LAST,
    depth=1,
    reliability=ReliabilityPolicy.RELIABLE,
    durability=DurabilityPolicy.TRANSIENT_LOCAL,
)
STREAM = QoSProfile(
    history=HistoryPolicy.KEEP_LAST,
    depth=5000,
    reliability=ReliabilityPolicy.RELIABLE,
    durability=DurabilityPolicy.VOLATILE,
)
SENSOR = QoSProfile(
    history=HistoryPolicy.KEEP_LAST,
    depth=200,
    reliability=ReliabilityPolicy.BEST_EFFORT,
    durability=DurabilityPolicy.VOLATILE,
)
EVENTS = QoSProfile(
    history=HistoryPolicy.KEEP_LAST,
    depth=50,
    reliability=ReliabilityPolicy.RELIABLE,
    durability=DurabilityPolicy.VOLATILE,
)


def command(period: float) -> QoSProfile:
    """For commands sent every `period` s; the deadline leaves room for a busy machine."""
    return QoSProfile(
        history=HistoryPolicy.KEEP_LAST,
        depth=1,
        reliability=ReliabilityPolicy.RELIABLE,
        durability=DurabilityPolicy.VOLATILE,
        deadline=Duration(seconds=max(4.0 * period, LEAST_DEADLINE)),
    )


def subscription_to(offered: list[ReliabilityPolicy]) -> QoSProfile:
    """STREAM, or best effort if any publisher on the topic offers no more than that."""
    if ReliabilityPolicy.BEST_EFFORT not in offered:
        return STREAM
    return QoSProfile(
        history=HistoryPolicy.KEEP_LAST,
        depth=STREAM.depth,
        reliability=ReliabilityPolicy.BEST_EFFORT,
        durability=DurabilityPolicy.VOLATILE,
    )


def following(asked: QoSProfile, offered: list[QoSProfile]) -> QoSProfile:
    """Return what to ask for in place of `asked` so that it matches every publisher.

    Reliable again where all are. What was latched stays so only while all are.
    """
    wanted = recording_of(offered)
    if asked.durability != DurabilityPolicy.TRANSIENT_LOCAL:
        wanted.durability = asked.durability  # or what is there already would come once more
    return wanted


def playing_of(recorded: tuple[Profile, ...]) -> QoSProfile:
    """STREAM, and latched if every publisher was when the bag was recorded.

    Reliable, whatever was offered: that serves every subscriber.
    """
    latched = bool(recorded) and all(profile.latched for profile in recorded)
    return QoSProfile(
        history=STREAM.history,
        depth=STREAM.depth,
        reliability=STREAM.reliability,
        durability=DurabilityPolicy.TRANSIENT_LOCAL if latched else STREAM.durability,
    )


def recording_of(offered: list[QoSProfile]) -> QoSProfile:
    """As `subscription_to`, and latched if every publisher is, so that a document published before
    the recording began is in it.
    """
    profile = subscription_to([publisher.reliability for publisher in offered])
    latched = bool(offered) and all(
        o.durability == DurabilityPolicy.TRANSIENT_LOCAL for o in offered
    )
    return QoSProfile(
        history=profile.history,
        depth=profile.depth,
        reliability=profile.reliability,
        durability=DurabilityPolicy.TRANSIENT_LOCAL if latched else profile.durability,
    )
