"""A short way for a stream: while its messages flow, the node waits for little else.

For every message rclpy's executor lists all that a node has, waits for all of it and makes a task:
half a millisecond where deciding about the sample takes thirty microseconds. The first message
after a pause comes by the executor; its callback then stays and waits for the lane's subscriptions
and the node's timers alone, until one of those is due or STAY has passed.
"""

import time
from collections.abc import Callable
from contextlib import ExitStack
from typing import Any, Final

from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.node import Node
from rclpy.qos import QoSProfile
from rclpy.subscription import Subscription

STAY: Final = 0.1  # s until services and other topics get their turn
BATCH: Final = 200  # messages in one go; then the other subscriptions get their turn

Received = Callable[[Any], None]


class Lane:
    """Subscriptions of a node, which has to be spun by one thread.

    In simulated time it stays for nothing: the clock comes by the executor. Neither does it with
    `stays` False, for a node beside others on one executor.
    """

    def __init__(self, node: Node, *, stays: bool) -> None:
        self._node = node
        self._stays = stays and not node.get_parameter("use_sim_time").value
        self._callbacks: dict[Subscription, Received] = {}

    def subscribe(self, kind: Any, topic: str, callback: Received, profile: QoSProfile) -> None:
        """As `node.create_subscription`."""

        def received(message: Any) -> None:
            callback(message)
            if self._stays:
                self._stay()

        subscription = self._node.create_subscription(kind, topic, received, profile)
        self._callbacks[subscription] = callback

    def clear(self) -> None:
        """Destroy the subscriptions."""
        for subscription in self._callbacks:
            self._node.destroy_subscription(subscription)
        self._callbacks = {}

    def _stay(self) -> None:
        """Take messages as they come, until something else has to be done."""
        until = time.monotonic_ns() + round(STAY * 1e9)
        timers = list(self._node.timers)
        with ExitStack() as stack:
            for handle in (*(s.handle for s in self._callbacks), *(t.handle for t in timers)):
                stack.enter_context(handle)
            waiting = rclpy_implementation.WaitSet(
                len(self._callbacks), 0, len(timers), 0, 0, 0, self._node.context.handle
            )
            stack.enter_context(waiting)
            self._take()
            while (ahead := until - time.monotonic_ns()) > 0 and self._node.context.ok():
                waiting.clear_entities()
                for subscription in self._callbacks:
                    waiting.add_subscription(subscription.handle)
                for timer in timers:
                    waiting.add_timer(timer.handle)
                waiting.wait(ahead)
                self._take()
                if waiting.get_ready_entities("timer"):
                    return

    def _take(self) -> None:
        """Call back for the messages that are there."""
        for subscription, callback in self._callbacks.items():
            for _ in range(BATCH):
                taken = subscription.handle.take_message(subscription.msg_type, False)
                if taken is None:
                    break
                callback(taken[0])
