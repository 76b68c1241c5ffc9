"""One call of a std_srvs/Trigger service, as `ros2 service call` makes where it is installed.

python -m nlsid_ros.calling [SERVICE]
"""

import sys
import time
from collections.abc import Callable

import rclpy
from rclpy.context import Context
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.node import Node
from rclpy.utilities import try_shutdown
from std_srvs.srv import Trigger

from nlsid_core.errors import DataError

NAME = "nlsid_call"
KIND = "std_srvs/srv/Trigger"
PATIENCE = 10.0  # s for the service to appear, and for its answer
LOOKS = 2.0  # s to hear of services


def call(service: str) -> tuple[bool, str]:
    """Whether it did what was asked, and what it answered; DataError if nobody answers."""
    with _Caller() as caller:
        client = caller.node.create_client(Trigger, service)
        if not caller.until(client.service_is_ready, PATIENCE):
            there = ", ".join(caller.services()) or "none"
            raise DataError(f"no service {service} of type {KIND}; there are: {there}")
        future = client.call_async(Trigger.Request())
        if not caller.until(future.done, PATIENCE):
            raise DataError(f"{service} did not answer within {PATIENCE:g} s")
        answer: Trigger.Response = future.result()
        return answer.success, answer.message


def services() -> list[str]:
    """Names of the services that `call` could call."""
    with _Caller() as caller:
        caller.until(lambda: False, LOOKS)
        return caller.services()


class _Caller:
    """A node of its own context, while it is needed."""

    def __enter__(self) -> "_Caller":
        self._context = Context()
        rclpy.init(context=self._context)
        self.node = Node(
            NAME, context=self._context, start_parameter_services=False, enable_rosout=False
        )
        self._executor = SingleThreadedExecutor(context=self._context)
        self._executor.add_node(self.node)
        return self

    def __exit__(self, *_: object) -> None:
        self.node.destroy_node()
        try_shutdown(context=self._context)

    def until(self, condition: Callable[[], bool], seconds: float) -> bool:
        """Spin until it holds, at most so long; whether it does."""
        end = time.monotonic() + seconds
        while not condition() and time.monotonic() < end:
            self._executor.spin_once(timeout_sec=0.05)
        return condition()

    def services(self) -> list[str]:
        """Of the nodes that run."""
        nodes = self.node.get_node_names_and_namespaces()
        known = [
            found
            for name, namespace in nodes
            if name != NAME
            for found in self.node.get_service_names_and_types_by_node(name, namespace)
        ]
        return sorted({name for name, kinds in known if KIND in kinds})


def main() -> None:
    """Call the named service and print its answer; without a name print what there is."""
    try:
        if len(sys.argv) < 2:
            print("\n".join(services()) or f"no service of type {KIND} is there")
            sys.exit(2)
        good, said = call(sys.argv[1])
    except DataError as error:
        print(f"error: {error}", file=sys.stderr)
        sys.exit(2)
    except (KeyboardInterrupt, ExternalShutdownException):
        sys.exit(130)
    print(said or ("done" if good else "refused"))
    sys.exit(0 if good else 1)


if __name__ == "__main__":
    main()
