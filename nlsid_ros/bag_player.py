"""Node `bag_player`: publishes a bag's messages as recorded, in order and at their pace.

Messages are published undecoded, so header stamps and every other byte are the recording's. Waits
for subscribers first, since a volatile topic forgets what nobody heard; ends with the bag.
"""

import time
from contextlib import ExitStack

from rclpy.duration import Duration
from rclpy.publisher import Publisher

from bags.recordings.bag import Bag
from nlsid_core.errors import DataError, NlsidError
from nlsid_ros import qos
from nlsid_ros.message_classes import message_class
from nlsid_ros.running import ManagedNode, Parameter, arm
from nlsid_ros.starting import entry_point

LOOK = 0.005  # s between looks at who listens
SETTLE = 1.0  # s: a subscriber learns of its match later than the publisher does
ACKNOWLEDGE = 5.0  # s: how long the end waits for reliable subscribers to have everything


class BagPlayer(ManagedNode):
    """Plays one bag once."""

    name = "bag_player"
    parameters = (
        Parameter("bag", "", "rosbag2 folder or .mcap file to play"),
        Parameter("topics", [""], "topics to play; none named: all"),
        Parameter("wait_for", 1, "subscribers each topic must have first", (0, 100)),
        Parameter("wait_timeout", 30.0, "s to wait for subscribers", (0.0, 3600.0)),
    )

    def read_parameters(self) -> None:
        """DataError if there is no bag."""
        if not self.values.bag:
            raise DataError("no bag to play; set the parameter bag")

    def start(self) -> None:
        """Make the topics, and play once they are listened to.

        Raises BagError if the bag cannot be read, DataError if a type is not installed.
        """
        with ExitStack() as opened:
            bag = opened.enter_context(Bag(self.values.bag))
            topics = [topic for topic in self.values.topics if topic] or list(bag.topics)
            self._players: dict[str, Publisher] = {
                topic: self.create_publisher(
                    message_class(bag.types_on(topic)[0]), topic, qos.playing_of(bag.offered(topic))
                )
                for topic in topics
            }
            self._messages = bag.messages(topics)
            self._message = next(self._messages, None)
            self._opened = opened.pop_all()
        self._began = time.monotonic()
        self._playing = self.later(self._play)
        self._waiting = self.every(LOOK, self._await_listeners)

    def stop(self) -> None:
        """Close the bag."""
        self._opened.close()

    def _await_listeners(self) -> None:
        """Have it played once every topic is listened to."""
        wanted, most = self.values.wait_for, self.values.wait_timeout
        missing = [t for t, p in self._players.items() if p.get_subscription_count() < wanted]
        if missing and time.monotonic() - self._began > most:
            self.end(
                DataError(
                    f"fewer than {wanted} subscribers on {', '.join(missing)} after {most:g} s; "
                    "start them, or set wait_for"
                )
            )
        if not missing:
            self._waiting.cancel()
            settle_ns = round(SETTLE * 1e9) if wanted else 1
            first_ns = 0 if self._message is None else self._message.log_time_ns
            self._later_ns = time.monotonic_ns() + settle_ns - first_ns
            arm(self._playing, settle_ns)

    def _play(self) -> None:
        """Publish what is due by now, and wait for the next; end with the bag."""
        now_ns = time.monotonic_ns() - self._later_ns
        try:
            while self._message is not None and self._message.log_time_ns <= now_ns:
                self._players[self._message.topic].publish(self._message.data)
                self._message = next(self._messages, None)
        except NlsidError as error:
            self.end(error)
            return
        if self._message is not None:
            arm(self._playing, self._message.log_time_ns - now_ns)
            return
        for publisher in self._players.values():
            publisher.wait_for_all_acked(Duration(seconds=ACKNOWLEDGE))
        self.get_logger().info(f"played {self.values.bag}")
        self.end()


main = entry_point(BagPlayer)

if __name__ == "__main__":
    main()
