"""The quality of service of every topic, and why.

DOCUMENT: a funnel, model or policy. Latched (transient local), so that a monitor that starts later
still gets it; one is enough, the newest counts.
STREAM: signals and margins. Reliable, because a lost sample ends a monitor's run, and deep enough
for five seconds at 1 kHz, so that a busy subscriber catches up. A reliable subscription does not
match a best-effort publisher: `following` matches what the publishers offer.
SENSOR: the response a controller acts on. Best effort matches every publisher, and an old sample
sent again would be too late to act on.
RECORDED: what a recorder asks for first: a STREAM, and what was latched before it came.
EVENTS: diagnostics. Reliable; a few pending are enough.
`command`: what a robot acts on. Reliable, and the newest only: an older one must not act after it.
Its deadline lets a base ask for commands in time, and hear from DDS when they are not.
"""

from rclpy.duration import Duration
from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy

from bags.recordings.quality import Profile

LEAST_DEADLINE = 0.05  # s


def _profile(depth: int, *, reliable: bool = True, latched: bool = False) -> QoSProfile:
    return QoSProfile(
        history=HistoryPolicy.KEEP_LAST,
        depth=depth,
        reliability=ReliabilityPolicy.RELIABLE if reliable else ReliabilityPolicy.BEST_EFFORT,
        durability=DurabilityPolicy.TRANSIENT_LOCAL if latched else DurabilityPolicy.VOLATILE,
    )


DOCUMENT = _profile(1, latched=True)
STREAM = _profile(5000)
RECORDED = _profile(5000, latched=True)
SENSOR = _profile(200, reliable=False)
EVENTS = _profile(50)


def command(period: float) -> QoSProfile:
    """For commands sent every `period` s; the deadline leaves room for a busy machine."""
    profile = _profile(1)
    profile.deadline = Duration(seconds=max(4.0 * period, LEAST_DEADLINE))
    return profile


def following(asked: QoSProfile, offered: list[QoSProfile]) -> QoSProfile:
    """Return what to ask for in place of `asked` so that it matches every publisher.

    Reliable where all are, and latched where that was asked for and all are. SENSOR stays: it
    matches everyone.
    """
    if asked == SENSOR or not offered:
        return asked
    return _profile(
        STREAM.depth,
        reliable=all(o.reliability != ReliabilityPolicy.BEST_EFFORT for o in offered),
        latched=_is_latched(asked) and all(map(_is_latched, offered)),
    )


def playing_of(recorded: tuple[Profile, ...]) -> QoSProfile:
    """STREAM, and latched if every publisher was when the bag was recorded.

    Reliable, whatever was offered: that serves every subscriber.
    """
    latched = bool(recorded) and all(profile.latched for profile in recorded)
    return _profile(STREAM.depth, latched=latched)


def _is_latched(profile: QoSProfile) -> bool:
    return bool(profile.durability == DurabilityPolicy.TRANSIENT_LOCAL)
