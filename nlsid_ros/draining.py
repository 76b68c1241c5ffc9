"""Subscriptions that take everything that has arrived, in one go.

rclpy's executor builds a wait set of all the node's entities for every message it takes, which is
most of what a message costs. `subscribe` wakes for a message and then takes all there are, so a
node that has fallen behind catches up; `Polled` subscriptions do not wake the node at all and are
taken from a timer, for those that only keep what comes.
"""

from collections.abc import Callable
from typing import Any

from rclpy.callback_groups import CallbackGroup
from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.node import Node
from rclpy.qos import QoSProfile
from rclpy.subscription import Subscription

BATCH = 200  # messages in one go; then timers and services get their turn

Received = Callable[[Any, dict[str, int]], None]


def subscribe(
    node: Node, kind: Any, topic: str, callback: Received, profile: QoSProfile
) -> Subscription:
    """As `node.create_subscription`, for a callback that takes a message and its info."""

    def take_all(message: Any, info: dict[str, int]) -> None:
        callback(message, info)
        take(subscription, callback)

    subscription: Subscription = node.create_subscription(
        kind,
        topic,
        take_all,  # type: ignore[arg-type]
        profile,
    )
    return subscription


def take(subscription: Subscription, callback: Received) -> None:
    """Call back for at most BATCH of the messages that are waiting now."""
    with subscription.handle:
        for _ in range(BATCH):
            taken = subscription.handle.take_message(subscription.msg_type, subscription.raw)
            if taken is None:
                return
            callback(*taken)


class Polled:
    """Raw subscriptions of a node whose messages wait until `take` is called."""

    def __init__(self, node: Node) -> None:
        self._node = node
        self._group = _Asleep()
        self._subscriptions: list[tuple[Subscription, Received]] = []

    def subscribe(
        self,
        kind: Any,
        topic: str,
        callback: Received,
        profile: QoSProfile,
        *,
        events: SubscriptionEventCallbacks,
    ) -> None:
        """Subscribe to the serialised messages on a topic."""
        subscription = self._node.create_subscription(
            kind,
            topic,
            callback,  # type: ignore[arg-type]
            profile,
            callback_group=self._group,
            event_callbacks=events,
            raw=True,
        )
        self._subscriptions.append((subscription, callback))

    def take(self) -> None:
        """Call back for the messages that are waiting now."""
        for subscription, callback in self._subscriptions:
            take(subscription, callback)


class _Asleep(CallbackGroup):
    """Keeps its subscriptions out of the executor's wait set; their events stay in."""

    def can_execute(self, entity: object) -> bool:
        return not isinstance(entity, Subscription)

    def beginning_execution(self, entity: object) -> bool:
        return self.can_execute(entity)

    def ending_execution(self, entity: object) -> None:
        pass
