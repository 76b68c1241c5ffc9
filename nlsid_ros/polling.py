"""Subscriptions that are taken from a timer, everything that has arrived in one go.

rclpy's executor builds a wait set of all the node's entities each time it wakes, which costs as
much as taking a hundred messages. For a node that only keeps what comes, `Polled` subscriptions do
not wake it at all. Their events are polled too: in a wait set an event wakes the node at every
message of its topic.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from rclpy.callback_groups import CallbackGroup
from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.impl.implementation_singleton import rclpy_implementation as _rclpy
from rclpy.node import Node
from rclpy.qos import QoSProfile
from rclpy.subscription import Subscription

BATCH = 200  # messages in one go; then timers and services get their turn

Received = Callable[[Any, dict[str, int]], None]


def take(subscription: Subscription, callback: Received, most: int = BATCH) -> int:
    """Call back for at most `most` of the messages that are waiting now; how many there were."""
    with subscription.handle:
        for count in range(most):
            taken = subscription.handle.take_message(subscription.msg_type, subscription.raw)
            if taken is None:
                return count
            callback(*taken)
    return most


@dataclass
class Source:
    """A polled subscription; its messages wait until it has a callback."""

    subscription: Subscription
    lost: Any
    incompatible: Any
    on_lost: Callable[[int], None]
    on_incompatible: Callable[[int], None]
    callback: Received | None = None
    begun: bool = False


class Polled:
    """Raw subscriptions of a node whose messages wait until `take` is called."""

    def __init__(self, node: Node) -> None:
        self._node = node
        self._group = _Asleep()
        self._sources: list[Source] = []

    def subscribe(
        self,
        kind: Any,
        topic: str,
        profile: QoSProfile,
        *,
        on_lost: Callable[[int], None],
        on_incompatible: Callable[[int], None],
    ) -> Source:
        """Subscribe to the serialised messages.

        `on_lost` hears how many more of them DDS lost, `on_incompatible` how many more publishers
        offer less than `profile` asks for.
        """
        subscription = self._node.create_subscription(
            kind,
            topic,
            lambda _message: None,
            profile,
            callback_group=self._group,
            event_callbacks=SubscriptionEventCallbacks(use_default_callbacks=False),
            raw=True,
        )
        kinds = _rclpy.rcl_subscription_event_type_t
        with subscription.handle:
            lost, incompatible = (
                _rclpy.EventHandle(subscription.handle, kind_of_event)
                for kind_of_event in (
                    kinds.RCL_SUBSCRIPTION_MESSAGE_LOST,
                    kinds.RCL_SUBSCRIPTION_REQUESTED_INCOMPATIBLE_QOS,
                )
            )
        self._sources.append(Source(subscription, lost, incompatible, on_lost, on_incompatible))
        return self._sources[-1]

    def take(self) -> None:
        """Call back for the messages that are waiting now, and for the events.

        What DDS calls lost with the first messages was sent while the subscription was made.
        """
        for source in self._sources:
            begun, depth = source.begun, source.subscription.qos_profile.depth
            if source.callback is not None:
                source.begun |= take(source.subscription, source.callback, depth) > 0
            if (count := _news(source.lost)) and begun:
                source.on_lost(count)
            if count := _news(source.incompatible):
                source.on_incompatible(count)

    def drop(self, source: Source) -> None:
        """Unsubscribe."""
        self._sources.remove(source)
        for event in (source.lost, source.incompatible):
            event.destroy_when_not_in_use()
        self._node.destroy_subscription(source.subscription)

    def drop_all(self) -> None:
        """Unsubscribe from everything."""
        for source in list(self._sources):
            self.drop(source)


def _news(event: Any) -> int:
    """By how much an event's count has risen."""
    with event:
        taken = event.take_event()
    return 0 if taken is None else int(taken.total_count_change)


class _Asleep(CallbackGroup):
    """Keeps its entities out of the executor's wait set."""

    def can_execute(self, entity: object) -> bool:  # noqa: ARG002
        return False

    def beginning_execution(self, entity: object) -> bool:  # noqa: ARG002
        return False

    def ending_execution(self, entity: object) -> None:
        pass
