"""Calls for help: services that stop the robot or keep what led here, asked until they answer."""

from collections.abc import Iterable

from rclpy.client import Client
from rclpy.task import Future
from std_srvs.srv import Trigger

from nlsid_ros.running import ManagedNode

RETRY = 0.5  # s until a service that has not answered is called again
THROTTLE = 5.0  # s between log lines about a service that does not answer


class Help:
    """Calls std_srvs/Trigger services until each has said that it did it.

    failures: why a service did not, by its name; empty if all did. asked: those still asked.
    """

    def __init__(self, node: ManagedNode, services: Iterable[str]) -> None:
        self.failures: dict[str, str] = {}
        self._node = node
        self._clients = [node.create_client(Trigger, name) for name in services if name]
        self.asked: dict[Client, Future | None] = {}
        self._retry = node.every(RETRY, self._ask)
        self._retry.cancel()

    def call(self) -> None:
        """Ask all of them, also those that did it before."""
        self.asked = dict.fromkeys(self._clients)
        self._ask()
        self._retry.reset()

    def call_off(self) -> None:
        """Ask nobody any more."""
        self.asked.clear()
        self.failures.clear()

    def _ask(self) -> None:
        """Ask those that have not said that they did it."""
        for client, future in list(self.asked.items()):
            answer = future.result() if future is not None and future.done() else None
            if answer is not None and answer.success:
                self._node.get_logger().info(f"{client.srv_name}: {answer.message}")
                self.failures.pop(client.srv_name, None)
                del self.asked[client]
                continue
            if future is not None:
                client.remove_pending_request(future)
                self.failures[client.srv_name] = answer.message if answer else "no answer"
            self.asked[client] = None
            if client.service_is_ready():
                self.asked[client] = client.call_async(Trigger.Request())
            else:
                self.failures[client.srv_name] = "not there to be called"
        for name, why in self.failures.items():
            self._node.get_logger().error(f"{name}: {why}", throttle_duration_sec=THROTTLE)
        if not self.asked:
            self._retry.cancel()
