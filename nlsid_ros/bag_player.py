"""Node `bag_player`: publishes a bag's messages as recorded, in order and at their pace.

Messages are published undecoded, so header stamps and every other byte are the recording's. Waits
for subscribers first, since a volatile topic forgets what nobody heard; ends with the bag.
"""

import sys
import time
from collections.abc import Mapping
from typing import Any

import rclpy
from rclpy.duration import Duration
from rclpy.executors import ExternalShutdownException
from rclpy.publisher import Publisher
from rclpy.utilities import ok, try_shutdown

from bags.recordings.bag import Bag
from bags.signals.grid import seconds
from nlsid_core.errors import DataError, NlsidError
from nlsid_ros import qos
from nlsid_ros.message_classes import message_class
from nlsid_ros.running import PlainNode, declare

NAME = "bag_player"
SLICE = 0.05  # s: longest sleep, so that an interrupt is noticed
SETTLE = 1.0  # s: a subscriber learns of its match later than the publisher does
ACKNOWLEDGE = 5.0  # s: how long the end waits for reliable subscribers to have everything


class BagPlayer(PlainNode):
    """Plays one bag once."""

    def __init__(self) -> None:
        super().__init__(NAME)
        self._path = str(declare(self, "bag", "", "rosbag2 folder or .mcap file to play"))
        topics: Any = declare(self, "topics", [""], "topics to play; none named: all")
        rate: Any = declare(self, "rate", 1.0, "speed, 1: as recorded", between=(0.01, 100.0))
        wait_for: Any = declare(
            self, "wait_for", 1, "subscribers each topic must have first", between=(0, 100)
        )
        timeout: Any = declare(
            self, "wait_timeout", 10.0, "s to wait for subscribers", between=(0.0, 3600.0)
        )
        self._topics = [topic for topic in topics if topic]
        self._rate, self._wait_for, self._timeout = rate, wait_for, timeout
        if not self._path:
            raise DataError("no bag to play; set the parameter bag")

    def play(self) -> None:
        """Publish the whole bag; returns early if ROS is shut down.

        Raises BagError if the bag cannot be read, DataError if a type is not installed or if
        subscribers do not come in time.
        """
        with Bag(self._path) as bag:
            names = self._topics or list(bag.topics)
            publishers = {
                topic: self.create_publisher(
                    message_class(bag.types_on(topic)[0]),
                    topic,
                    qos.playing_of(bag.offered(topic)),
                )
                for topic in names
            }
            self._await_subscribers(publishers)
            start = time.monotonic()
            first_ns: int | None = None
            for count, message in enumerate(bag.messages(names), start=1):
                first_ns = message.log_time_ns if first_ns is None else first_ns
                due = start + seconds(message.log_time_ns, first_ns) / self._rate
                while (ahead := due - time.monotonic()) > 0 and ok():
                    time.sleep(min(ahead, SLICE))
                if not ok():
                    self.get_logger().info(f"stopped after {count - 1} messages")
                    return
                publishers[message.topic].publish(message.data)
            for publisher in publishers.values():
                publisher.wait_for_all_acked(Duration(seconds=ACKNOWLEDGE))
        self.get_logger().info(f"played {self._path}")

    def _await_subscribers(self, publishers: Mapping[str, Publisher]) -> None:
        deadline = time.monotonic() + self._timeout
        while ok():
            counts = {topic: p.get_subscription_count() for topic, p in publishers.items()}
            if all(count >= self._wait_for for count in counts.values()):
                if self._wait_for:
                    time.sleep(SETTLE)
                return
            if time.monotonic() > deadline:
                missing = ", ".join(t for t, n in counts.items() if n < self._wait_for)
                raise DataError(
                    f"fewer than {self._wait_for} subscribers on {missing} after "
                    f"{self._timeout:g} s; start them, or set wait_for"
                )
            time.sleep(SLICE / 10)


def main(args: list[str] | None = None) -> None:
    """Entry point of `ros2 run nlsid bag_player`."""
    try:
        rclpy.init(args=args)
        player = BagPlayer()
        player.play()
        player.destroy_node()
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    except (NlsidError, OSError) as error:
        sys.exit(f"{NAME}: {error}")
    finally:
        try_shutdown()


if __name__ == "__main__":
    main()
