"""The latched bundle of a proved funnel, decided by the kernel before anything uses it.

Of a continuous funnel parameters say where its signals are.
"""

import re
from collections.abc import Callable
from types import SimpleNamespace

from std_msgs.msg import String

from bags.designs import wiring
from bags.designs.bundle import MAX_BYTES, Bundle
from nlsid_core.deciding import USUAL, Deciding, Limits
from nlsid_core.designs import AnyDesign, Wiring
from nlsid_core.errors import DataError, NlsidError
from nlsid_ros import graph, qos
from nlsid_ros.running import ManagedNode, Parameter

LOOK = 0.2  # s between looks at who publishes, and at a check that is on
CHECKING = "checking the proof"
LONG = 5.0  # s of checking, after which it is said
OF_A_CONTINUOUS = (
    "of a continuous funnel: topic:field paths separated by commas, all on one topic; empty: the "
    "model says it"
)
CHECK = (
    Parameter(
        "check_seconds",
        USUAL.seconds,
        "s of processor time that the check of a proof may take",
        (1, 3600),
    ),
    Parameter(
        "check_memory",
        USUAL.memory,
        "MB of memory that the check of a proof may take",
        (64, 10**6),
    ),
)
DESIGN = (
    *CHECK,
    Parameter("source", "funnel_publisher", "node that publishes the funnel"),
    Parameter("response", "", f"the state {OF_A_CONTINUOUS}"),
    Parameter("command", "", f"the inputs {OF_A_CONTINUOUS}"),
    Parameter("period", 0.0, "s between samples of a continuous funnel", (0.0, 60.0)),
    Parameter(
        "expected_digest",
        "",
        "SHA-256 of the only funnel.json to be used, as sha256sum prints it; empty: any proved",
    ),
)
_DIGEST = re.compile(r"(sha256:)?[0-9a-f]{64}", re.ASCII)


def wiring_of(values: SimpleNamespace) -> Wiring | None:
    """Where a continuous funnel's state and inputs are, by the parameters of DESIGN; None if unset.

    Raises BagError if they are no paths.
    """
    y, u = (
        [path.strip() for path in text.split(",") if path]
        for text in (values.response, values.command)
    )
    return wiring.wiring_of(y, u, values.period)


def expected_of(values: SimpleNamespace) -> str:
    """The digest that pins the funnel, empty if none does; DataError if it is no digest."""
    expected = values.expected_digest
    if expected and not _DIGEST.fullmatch(expected):
        raise DataError(f"expected_digest is '{expected}'; it should have 64 hexadecimal digits")
    return "sha256:" + expected.removeprefix("sha256:") if expected else ""


def limits_of(values: SimpleNamespace) -> Limits:
    """What the check of a proof may take, by the parameters of CHECK."""
    return Limits(values.check_seconds, values.check_memory)


class Unproved:
    """In the place of a `DesignSubscription`: a policy from files, of which nothing is proved."""

    digest, refusal, state = "", "", "no design: a policy that is not proved"

    def close(self) -> None:
        """There is no check to call off."""


class DesignSubscription:
    """Calls `taken` with the design that `source` publishes and its funnel's digest, once the
    kernel has proved it here, and again when it has proved another; the same one again changes
    nothing.

    It is decided in a process of its own, while the node goes on. `state` says what becomes of it,
    `refusal` why the newest was not used, empty if it was; `changed` is called when either changes.
    With two publishers on the topic nothing is used until one of them is gone.
    """

    def __init__(
        self,
        node: ManagedNode,
        taken: Callable[[AnyDesign, str], None],
        changed: Callable[[], None],
    ) -> None:
        self._node, self._taken, self._changed = node, taken, changed
        self._wiring, self._expected = wiring_of(node.values), expected_of(node.values)
        self._limits = limits_of(node.values)
        self._deciding: Deciding | None = None
        self._waiting: str | None = None
        self._used = ""  # the text of the design in use
        self._crowded = False
        self.digest = self.refusal = self._verdict = ""
        self.state = "waiting for a design"
        self._subscribe()
        node.every(LOOK, self._look)

    def close(self) -> None:
        """Call off a check that is on."""
        if self._deciding is not None:
            self._deciding.close()
            self._deciding = None

    def _subscribe(self) -> None:
        self._subscription = self._node.create_subscription(
            String, f"{self._node.values.source}/design", self._on_bundle, qos.DOCUMENT
        )

    def _on_bundle(self, message: String) -> None:
        if self._is_crowded():
            return
        if len(message.data) > MAX_BYTES:
            self.close()  # of what was the newest until now
            self._waiting = None
            self._refuse(f"it has {len(message.data)} characters; at most {MAX_BYTES} are read")
            return
        self._waiting = message.data
        if message.data == self._used:
            self.close()
            self._waiting, self.refusal, self.state = None, "", self._verdict
            self._changed()
        self._look()

    def _is_crowded(self) -> bool:
        """Whether several publish designs here: nobody can know whose counts."""
        topic = self._subscription.topic_name
        count = self._node.count_publishers(topic)
        if count > 1:
            if not self._crowded:
                self._refuse(
                    f"{topic} has {count} publishers; stop all but one, or wait if one died"
                )
            self._crowded = True
            self._waiting = None
        elif self._crowded and count == 1:  # which the one that is left has published is not known
            self._crowded = False
            self._node.destroy_subscription(self._subscription)
            self._subscribe()
        return self._crowded

    def _unheard(self) -> str:
        """Who publishes designs here so that this node cannot hear them; empty if nobody does."""
        topic = self._subscription.topic_name
        for publisher in self._node.get_publishers_info_by_topic(topic):
            if why := graph.mismatch(publisher.qos_profile, qos.DOCUMENT):
                return f"{graph.names([publisher])} cannot be heard on {topic}: {why}"
        return ""

    def _look(self) -> None:
        """Have the newest design decided, and take what the kernel has decided."""
        if self._is_crowded():
            self.close()
        if (unheard := self._unheard()) and not self.refusal.endswith(unheard):
            self._refuse(unheard)
        try:
            if self._deciding is None and self._waiting is not None:
                self._text, self._waiting = self._waiting, None
                self._bundle = Bundle.parse(self._text)
                self._deciding = self._bundle.deciding(self._limits)
                self.state = CHECKING
                self._changed()
            if self._deciding is not None:
                self._poll(self._deciding)
        except (NlsidError, OSError) as refusal:
            self.close()
            self._refuse(str(refusal))

    def _poll(self, deciding: Deciding) -> None:
        """Take the design if the kernel has proved it; raises why it is not used."""
        verdict, bundle = deciding.poll(), self._bundle
        if verdict is None:
            if deciding.seconds > LONG:
                said = f"{CHECKING} for {deciding.seconds:.0f} s now"
                self.state = f"{said}: it is slow where others want the processors"
            return
        self.close()
        bundle.refuse_others(verdict)
        if self._expected and bundle.digest != self._expected:
            raise DataError(f"its funnel is {bundle.digest}, not the expected {self._expected}")
        if bundle.digest != self.digest:
            self._taken(bundle.design(self._wiring), bundle.digest)
        when = " (decided before on this machine)" if deciding.before else ""
        self._used, self._verdict, self.digest = self._text, f"{verdict}{when}", bundle.digest
        self.refusal, self.state = "", self._verdict
        self._changed()

    def _refuse(self, reason: str) -> None:
        self.refusal = self.state = f"design refused: {reason}"
        self._node.get_logger().error(self.refusal)
        self._changed()
