"""What every node shares: its lifecycle, its parameters, and a `main` that starts and stops it."""

import gc
import os
import signal
import socket
import subprocess
import sys
import threading
import traceback
from array import array
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from typing import Any, ClassVar, NamedTuple

import rclpy
from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState
from rcl_interfaces.msg import (
    FloatingPointRange,
    IntegerRange,
    ParameterDescriptor,
    SetParametersResult,
)
from rclpy.callback_groups import CallbackGroup
from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.exceptions import NameValidationException, ParameterException
from rclpy.experimental.events_executor import EventsExecutor
from rclpy.lifecycle import LifecycleNode, LifecycleState, TransitionCallbackReturn
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.qos import QoSProfile
from rclpy.service import Service
from rclpy.signals import SignalHandlerOptions
from rclpy.subscription import Subscription
from rclpy.timer import Timer
from rclpy.utilities import try_shutdown

from nlsid_core.errors import DataError, NlsidError
from nlsid_ros import shared_memory, watchdog

CONFIGURE = Transition.TRANSITION_CONFIGURE
STOP_SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
Arguments = Sequence[str] | None  # of a node that shares its process: `--ros-args ...`
Value = str | float | bool | Sequence[str] | Sequence[float]


class Declared(NamedTuple):
    """A parameter as a node declared it."""

    name: str
    default: Value
    description: str
    between: tuple[float, float] | None
    tunable: bool
    several: bool = False


class PlainNode(Node):
    """A node without a lifecycle, which remembers what it declared."""

    def __init__(self, name: str) -> None:
        super().__init__(name)
        self.declared: list[Declared] = []


class ManagedNode(LifecycleNode):
    """A node with ROS 2's lifecycle: parameters and `prepare` when it is configured, `start` on
    activation, `stop` after.

    Whatever `start` makes (publishers, subscriptions, services, timers, clients) is destroyed on
    deactivation. With `autostart` it is configured and activated at once. With `arguments` it takes
    those instead of the process's. is_watched: it ends if its executor stands still
    (`nlsid_ros.watchdog`); so it must not sleep for long.
    """

    is_watched: ClassVar[bool] = False

    def __init__(self, name: str, arguments: Arguments = None) -> None:
        try:
            super().__init__(name, cli_args=arguments, use_global_arguments=arguments is None)
        except (RuntimeError, NameValidationException, ParameterException) as error:
            raise _unreadable(error) from error
        self.declared: list[Declared] = []
        self._is_configured = False
        self.add_on_set_parameters_callback(self._on_parameters)
        self.autostart = bool(
            declare(self, "autostart", True, "start at once; false: wait for a lifecycle manager")
        )
        self._started_itself = False
        manager = next(each for each in self.services if each.srv_type is ChangeState)
        self._change_state, manager.callback = manager.callback, self._on_change_state
        self.failure: Exception | None = None
        self._running = False
        self._made_before: set[object] = set()
        try:
            self.read_parameters()
        except NlsidError as error:
            if self.autostart:
                raise
            self.get_logger().warning(f"cannot be configured as it is: {error}")

    def read_parameters(self) -> None:
        """Declare the parameters and take their values; called again when it is configured."""

    def prepare(self) -> None:
        """Check whatever can be checked before starting: files, names."""

    def start(self) -> None:
        """Make publishers and subscriptions, and work."""

    def stop(self) -> None:
        """Finish: send the last command, close files."""

    def tune(self, values: Mapping[str, Any]) -> None:
        """Use these values of the tunable parameters from now on.

        Raises NlsidError or OSError to refuse them; all stays as it was then.
        """

    def tunable(self) -> dict[str, Any]:
        """The tunable parameters' values."""
        tunable = (declared for declared in self.declared if declared.tunable)
        return {d.name: _as_meant(d, self.get_parameter(d.name).value) for d in tunable}

    def signal_topic(self, topic: str) -> str:
        """Where a signal that a bag or a model calls `topic` is: in the node's namespace.

        /odom is /robot1/odom for a node in /robot1, and so is /robot1/odom. Remapping comes after.
        """
        namespace = self.get_namespace()
        inside = namespace == "/" or topic.startswith(f"{namespace}/")
        return topic if inside else topic.removeprefix("/")

    def start_itself(self) -> None:
        """Configure and activate without a manager; raises what made it fail."""
        for transition in (self.trigger_configure, self.trigger_activate):
            if transition() != TransitionCallbackReturn.SUCCESS and self.failure is not None:
                raise self.failure
        self._started_itself = True

    def _on_change_state(
        self, request: ChangeState.Request, answer: ChangeState.Response
    ) -> ChangeState.Response:
        """As rclpy does it, which ends the process where the state has no such transition.

        A manager brings up what it believes unconfigured; a node that started itself goes back
        there once, so that both can be used.
        """
        label = request.transition.label
        wanted = label == "configure" if label else request.transition.id == CONFIGURE
        try:
            if wanted and self._started_itself:
                self.trigger_deactivate()
                self.trigger_cleanup()
            done: ChangeState.Response = self._change_state(request, answer)
        except RuntimeError as error:
            self.get_logger().error(f"transition refused: {error}")
            answer.success = False
            return answer
        return done

    def on_configure(self, _state: LifecycleState) -> TransitionCallbackReturn:
        """Transition: unconfigured to inactive."""

        def configure() -> None:
            self.read_parameters()
            self.prepare()
            self._is_configured = True

        return self._attempt(configure)

    def on_activate(self, _state: LifecycleState) -> TransitionCallbackReturn:
        """Transition: inactive to active."""
        self._made_before = set(self.entities())
        result = self._attempt(self.start)
        self._running = result == TransitionCallbackReturn.SUCCESS
        if not self._running:
            self._destroy_made()
        return result

    def on_deactivate(self, _state: LifecycleState) -> TransitionCallbackReturn:
        """Transition: active to inactive."""
        self._running = self._started_itself = False
        result = self._attempt(self.stop)
        self._destroy_made()
        return result

    def on_cleanup(self, _state: LifecycleState) -> TransitionCallbackReturn:
        """Transition: inactive to unconfigured."""
        self._is_configured = False
        return TransitionCallbackReturn.SUCCESS

    def on_shutdown(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Transition: to finalized."""
        return self.on_deactivate(state) if self._running else TransitionCallbackReturn.SUCCESS

    def destroy_node(self) -> None:
        """Stop, then destroy the node."""
        if self._running:
            self._running = False
            self.stop()
        super().destroy_node()

    def _on_parameters(self, changed: list[Parameter]) -> SetParametersResult:
        values = self.tunable()
        asked = {parameter.name: parameter.value for parameter in changed}
        try:
            for each in self.declared:
                if each.name in asked:
                    asked[each.name] = _as_meant(each, asked[each.name])
            if not self._is_configured:
                return SetParametersResult(successful=True)  # read when it is configured
            if fixed := {d.name for d in self.declared} & asked.keys() - values.keys():
                raise DataError(f"{', '.join(sorted(fixed))}: read when the node is configured")
            if not asked.keys() & values.keys():
                return SetParametersResult(successful=True)
            self.tune({name: asked.get(name, value) for name, value in values.items()})
        except (NlsidError, OSError) as refusal:
            return SetParametersResult(successful=False, reason=str(refusal))
        return SetParametersResult(successful=True)

    def _attempt(self, work: Callable[[], None]) -> TransitionCallbackReturn:
        try:
            try:
                work()
            except NameValidationException as error:
                raise _unreadable(error) from error
        except (NlsidError, OSError) as error:
            self.failure = error
            self.get_logger().error(str(error))
            return TransitionCallbackReturn.FAILURE
        except Exception as error:  # rclpy would swallow it
            self.failure = error
            self.get_logger().fatal(traceback.format_exc())
            return TransitionCallbackReturn.ERROR
        return TransitionCallbackReturn.SUCCESS

    def create_subscription(  # type: ignore[override]
        self,
        msg_type: Any,
        topic: str,
        callback: Callable[..., None],
        qos_profile: QoSProfile | int,
        *,
        callback_group: CallbackGroup | None = None,
        raw: bool = False,
    ) -> Subscription:
        """As rclpy does it, without the middleware's events: to take one can wait for ever."""
        return super().create_subscription(
            msg_type,
            topic,
            callback,
            qos_profile,
            callback_group=callback_group,
            event_callbacks=SubscriptionEventCallbacks(use_default_callbacks=False),
            raw=raw,
        )

    def destroy_subscription(self, subscription: Subscription) -> bool:
        """As rclpy does it; what had arrived is let go (see `_let_go`)."""
        subscription.callback = _let_go
        return bool(super().destroy_subscription(subscription))

    def destroy_timer(self, timer: Timer) -> bool:
        """As rclpy does it; if it was due, it is no longer."""
        timer.callback = _let_go
        return bool(super().destroy_timer(timer))

    def destroy_service(self, service: Service) -> bool:
        """As rclpy does it; a request that had arrived stays without an answer."""
        service.callback = _let_go  # type: ignore[assignment]
        service.send_response = _let_go  # type: ignore[assignment, method-assign]
        return bool(super().destroy_service(service))

    def entities(self) -> list[object]:
        """Everything the node communicates with, and its timers."""
        kinds = (self.publishers, self.subscriptions, self.services, self.timers, self.clients)
        return [entity for kind in kinds for entity in kind]

    def _destroy_made(self) -> None:
        destroy: tuple[tuple[Iterable[Any], Callable[[Any], bool]], ...] = (
            (self.timers, self.destroy_timer),
            (self.subscriptions, self.destroy_subscription),
            (self.services, self.destroy_service),
            (self.clients, self.destroy_client),
            (self.publishers, self.destroy_publisher),
        )
        for entities, remove in destroy:
            for entity in list(entities):
                if entity not in self._made_before:
                    remove(entity)


def _let_go(*_given: object) -> None:
    """In the place of a destroyed entity's callback: EventsExecutor still calls it for what it had
    queued before.
    """


def run(make: Callable[[], ManagedNode], args: list[str] | None) -> None:
    """`run_all` of one node, which takes `args`."""
    run_all([make], args)


def run_all(makes: Sequence[Callable[[], ManagedNode]], args: list[str] | None) -> None:
    """Make the nodes, start each that starts itself, and spin until SIGINT, SIGTERM
    or SIGHUP (a terminal that is closed, unless `nohup` says that it does not matter).

    The signals are waited for here and not left to rclpy, which would end all communication before
    the node could send a last command. Raises what made the node fail to start.
    """
    woken = _wake_on_signals()
    shared_memory.avoid_what_is_stale()
    try:
        rclpy.init(args=args, signal_handler_options=SignalHandlerOptions.NO)
    except RuntimeError as error:
        raise _unreadable(error) from error
    nodes: list[ManagedNode] = []
    try:
        for make in makes:
            nodes.append(make())
            if nodes[-1].autostart:
                nodes[-1].start_itself()
        gc.collect()
        gc.freeze()  # what is here stays: no collection has to look through it in mid-stream
        with _watched(nodes):
            _spin_until_signalled(nodes, woken)
    finally:
        with ExitStack() as ending:  # each is stopped, also if another cannot be
            ending.callback(try_shutdown)
            for node in reversed(nodes):
                ending.callback(node.destroy_node)


@contextmanager
def _watched(nodes: Sequence[ManagedNode]) -> Iterator[None]:
    """A watchdog beside this process, in a session of its own, where Ctrl-C does not reach it."""
    if not all(node.is_watched for node in nodes):
        yield
        return
    names = ", ".join(node.get_name() for node in nodes)
    command = [sys.executable, "-I", "-S", watchdog.__file__, str(os.getpid()), names]
    with subprocess.Popen(command, stdin=subprocess.DEVNULL, start_new_session=True) as watching:
        try:
            yield
        finally:
            watching.kill()


def _unreadable(error: Exception) -> DataError:
    """What ROS cannot use of arguments or names, without where its code says so."""
    said = str(error).partition(". Error:")[0].partition(", at /")[0]
    hint = "; a namespace begins with a slash: /robot1" if "__ns" in said else ""
    return DataError(f"ROS refuses: {' '.join(said.split())}{hint}")


def _spin_until_signalled(nodes: Sequence[ManagedNode], woken: socket.socket) -> None:
    """What had arrived when the signal came is still handed on.

    By `spin_once` with a timeout: without one the executor hears nothing.
    """
    executor = EventsExecutor()
    for node in nodes:
        executor.add_node(node)
    asked = threading.Event()

    def wait() -> None:
        woken.recv(1)
        executor.create_task(asked.set)  # goes to the end of the queue

    threading.Thread(target=wait, daemon=True).start()
    while not asked.is_set():
        executor.spin_once(timeout_sec=0.1)


def _wake_on_signals() -> socket.socket:
    """A socket that gets a byte at once when a stop signal comes, whatever Python is waiting in."""
    receiver, sender = socket.socketpair()
    sender.setblocking(False)
    signal.set_wakeup_fd(sender.detach())
    for number in STOP_SIGNALS:
        if number is not signal.SIGHUP or signal.getsignal(number) is not signal.SIG_IGN:
            signal.signal(number, lambda _number, _frame: None)
    return receiver


def declare(
    node: Node,
    name: str,
    default: Value,
    description: str,
    *,
    between: tuple[float, float] | None = None,
    tunable: bool = False,
    several: bool = False,
) -> Value:
    """Declare a parameter with its description and range, once, and return its value.

    Of a ManagedNode it can be changed while the node is unconfigured, and while it runs only if
    `tunable`: `ManagedNode.tune` is told then. several: a list of numbers is taken, too.

    The default's type is the parameter's, and 2 is taken where 2.0 is meant. Raises DataError if
    the value given has another type or is out of range.
    """
    declared = Declared(name, default, description, between, tunable, several)
    if node.has_parameter(name):
        return _as_meant(declared, node.get_parameter(name).value)
    is_fixed = not isinstance(node, ManagedNode)
    descriptor = ParameterDescriptor(name=name, description=description, read_only=is_fixed)
    descriptor.dynamic_typing = isinstance(default, float)  # or ROS would refuse 2 for 2.0
    if between is not None:
        lo, hi = between
        if isinstance(default, int):
            descriptor.integer_range = [IntegerRange(from_value=int(lo), to_value=int(hi))]
        else:
            descriptor.floating_point_range = [FloatingPointRange(from_value=lo, to_value=hi)]
    try:
        given = node.declare_parameter(name, default, descriptor).value
    except ParameterException as error:
        raise DataError(f"parameter {name} ({description}): {error}") from error
    if isinstance(node, ManagedNode | PlainNode):
        node.declared.append(declared)
    return _as_meant(declared, given)


def _as_meant(declared: Declared, given: Any) -> Value:
    """A number as float where one is meant; DataError if it is none or is out of range."""
    value: Value = given
    if not isinstance(declared.default, float):
        return value
    what = f"parameter {declared.name} ({declared.description})"
    if declared.several and isinstance(given, array | list | tuple) and len(given):
        return [_a_number(declared, what, each) for each in given]
    return _a_number(declared, what, given)


def _a_number(declared: Declared, what: str, given: Any) -> float:
    if isinstance(given, bool) or not isinstance(given, int | float):
        raise DataError(f"{what}: {given!r} is not a number")
    if declared.between is not None and not declared.between[0] <= given <= declared.between[1]:
        raise DataError(f"{what}: {given} is not in [{declared.between[0]}, {declared.between[1]}]")
    return float(given)


def declare_number(
    node: Node,
    name: str,
    default: float,
    description: str,
    *,
    between: tuple[float, float],
    tunable: bool = False,
) -> float:
    """`declare` for a float parameter."""
    value = declare(node, name, float(default), description, between=between, tunable=tunable)
    assert isinstance(value, float)
    return value


def declare_text(
    node: Node, name: str, default: str, description: str, *, tunable: bool = False
) -> str:
    """`declare` for a string parameter."""
    return str(declare(node, name, default, description, tunable=tunable))
