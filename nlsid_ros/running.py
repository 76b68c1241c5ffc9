"""What every node shares: its lifecycle, its parameters, its timers, services and diagnostics."""

import socket
import traceback
from array import array
from collections.abc import Callable, Mapping, Sequence
from types import SimpleNamespace
from typing import Any, ClassVar, NamedTuple

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState
from rcl_interfaces.msg import (
    FloatingPointRange,
    IntegerRange,
    ParameterDescriptor,
    SetParametersResult,
)
from rclpy.callback_groups import CallbackGroup
from rclpy.clock import Clock
from rclpy.clock_type import ClockType
from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.exceptions import NameValidationException, ParameterException
from rclpy.lifecycle import LifecycleNode, LifecycleState, TransitionCallbackReturn
from rclpy.parameter import Parameter as Given
from rclpy.qos import QoSProfile
from rclpy.subscription import Subscription
from rclpy.timer import Timer
from std_srvs.srv import Trigger

from nlsid_core.errors import DataError, NlsidError
from nlsid_ros import qos

CONFIGURE = Transition.TRANSITION_CONFIGURE
REPORT = 1.0  # s between diagnostics while nothing changes
Arguments = Sequence[str] | None  # of a node that shares its process: `--ros-args ...`
Value = str | float | bool | Sequence[str] | Sequence[float]


class Parameter(NamedTuple):
    """An option of a node. The default's type is its own; 2 is taken where 2.0 is meant.

    between: least and greatest number. tunable: it can be changed while the node runs. several: a
    list of numbers is taken, too.
    """

    name: str
    default: Value
    what: str
    between: tuple[float, float] | None = None
    tunable: bool = False
    several: bool = False

    @property
    def said(self) -> str:
        """Its name and what it is, for a message."""
        return f"parameter {self.name} ({self.what})"

    def descriptor(self) -> ParameterDescriptor:
        """What ROS knows of it."""
        described = ParameterDescriptor(name=self.name, description=self.what)
        described.dynamic_typing = isinstance(self.default, float)  # or ROS would refuse 2 for 2.0
        if self.between is None:
            return described
        lo, hi = self.between
        if isinstance(self.default, int):
            described.integer_range = [IntegerRange(from_value=int(lo), to_value=int(hi))]
        else:
            described.floating_point_range = [FloatingPointRange(from_value=lo, to_value=hi)]
        return described

    def meant(self, given: Any) -> Value:
        """The value given, a number as float where one is meant.

        Raises DataError if it is no number where one is meant, or is out of range.
        """
        if not isinstance(self.default, float):
            value: Value = given
            return value
        if self.several and isinstance(given, array | list | tuple) and len(given):
            return [self._number(each) for each in given]
        return self._number(given)

    def _number(self, given: Any) -> float:
        if isinstance(given, bool) or not isinstance(given, int | float):
            raise DataError(f"{self.said}: {given!r} is not a number")
        if self.between is not None and not self.between[0] <= given <= self.between[1]:
            raise DataError(
                f"{self.said}: {given} is not in [{self.between[0]}, {self.between[1]}]"
            )
        return float(given)


AUTOSTART = Parameter("autostart", True, "start at once; false: wait for a lifecycle manager")
HARDWARE = Parameter("hardware_id", "", "of the status on /diagnostics; empty: the host's name")


class ManagedNode(LifecycleNode):
    """A node with ROS 2's lifecycle: parameters and `prepare` when it is configured, `start` on
    activation, `stop` after.

    Whatever `start` makes (publishers, subscriptions, services, timers, clients) is destroyed on
    deactivation. With `autostart` it is configured and activated at once. With `arguments` it takes
    those instead of the process's.

    name: the node's. task: what its status is about. parameters: what it declares; their values are
    in `values`, read anew when it is configured. is_watched: it ends if its executor stands still
    (`nlsid_ros.watchdog`); so it must not sleep for long. is_over: it has nothing left to do, and
    its process ends.
    """

    name: ClassVar[str]
    task: ClassVar[str]
    parameters: ClassVar[tuple[Parameter, ...]]
    is_watched: ClassVar[bool] = False

    def __init__(self, arguments: Arguments = None) -> None:
        try:
            super().__init__(self.name, cli_args=arguments, use_global_arguments=arguments is None)
        except (RuntimeError, NameValidationException, ParameterException) as error:
            raise unreadable(error) from error
        self.failure: Exception | None = None
        self.is_over = False
        self.values = SimpleNamespace()
        self._is_configured = self._is_running = self._started_itself = False
        self.steady = Clock(clock_type=ClockType.STEADY_TIME)
        self._made_before: set[object] = set()
        manager = next(each for each in self.services if each.srv_type is ChangeState)
        self._change_state, manager.callback = manager.callback, self._on_change_state
        self.autostart = bool(self._declared(AUTOSTART))
        self._hardware = str(self._declared(HARDWARE)) or socket.gethostname()
        try:
            self._read()
        except NlsidError as error:
            if self.autostart:
                raise
            self.get_logger().warning(f"cannot be configured as it is: {error}")
        self.add_on_set_parameters_callback(self._on_parameters)

    def read_parameters(self) -> None:
        """Check `values`, and derive from them what is not read as it is."""

    def prepare(self) -> None:
        """Check whatever can be checked before starting: files, names."""

    def start(self) -> None:
        """Make publishers and subscriptions, and work."""

    def stop(self) -> None:
        """Finish: send the last command, close files."""

    def tune(self, values: SimpleNamespace) -> None:
        """Use these values of the parameters from now on; those that are not tunable are as before.

        Raises NlsidError or OSError to refuse them; all stays as it was then.
        """

    def every(self, period: float, callback: Callable[[], None]) -> Timer:
        """Make a timer on the wall's time, which also goes on while simulated time stands still."""
        return self.create_timer(period, callback, clock=self.steady)

    def later(self, callback: Callable[[], None], clock: Clock | None = None) -> Timer:
        """Make a timer that waits to be armed (`arm`), on this clock or on the wall's time."""
        timer = self.create_timer(1.0, callback, clock=clock or self.steady)
        timer.cancel()
        return timer

    def serve(self, name: str, answer: Callable[[], tuple[bool, str]]) -> None:
        """Make the service ~/name, which says whether it did it and what, or why it could not."""

        def serve(_request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
            try:
                response.success, response.message = answer()
            except (NlsidError, OSError) as error:
                response.success, response.message = False, str(error)
            return response

        self.create_service(Trigger, f"~/{name}", serve)

    def keep_reporting(self, callback: Callable[[], None]) -> None:
        """Make /diagnostics, and have `callback` `report` to it every second."""
        self._diagnostics = self.create_publisher(DiagnosticArray, "/diagnostics", qos.EVENTS)
        self.every(REPORT, callback)

    def report(self, level: bytes, text: str, values: Mapping[str, str]) -> DiagnosticArray:
        """Say how the node is; level: a constant of DiagnosticStatus. Return what was published.

        The status is called `namespace/node: task`, so that two robots' are told apart.
        """
        status = DiagnosticStatus(level=level, message=text, hardware_id=self._hardware)
        status.name = f"{self.get_fully_qualified_name().removeprefix('/')}: {self.task}"
        status.values = [KeyValue(key=key, value=value) for key, value in values.items()]
        message = DiagnosticArray(status=[status])
        message.header.stamp = self.get_clock().now().to_msg()
        self._diagnostics.publish(message)
        return message

    @property
    def data_clock(self) -> Clock:
        """The clock that patience counts on: simulated time, or one that nobody sets."""
        return self.get_clock() if self.get_parameter("use_sim_time").value else self.steady

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

    def end(self, failure: Exception | None = None) -> None:
        """Have the process end, and fail if something failed."""
        self.is_over, self.failure = True, failure

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
            self._read()
            self.prepare()
            self._is_configured = True

        return self._attempt(configure)

    def on_activate(self, _state: LifecycleState) -> TransitionCallbackReturn:
        """Transition: inactive to active."""
        self._made_before = set(self.entities())
        result = self._attempt(self.start)
        self._is_running = result == TransitionCallbackReturn.SUCCESS
        if not self._is_running:
            self._destroy_made()
        return result

    def on_deactivate(self, _state: LifecycleState) -> TransitionCallbackReturn:
        """Transition: active to inactive."""
        self._is_running = self._started_itself = False
        result = self._attempt(self.stop)
        self._destroy_made()
        return result

    def on_cleanup(self, _state: LifecycleState) -> TransitionCallbackReturn:
        """Transition: inactive to unconfigured."""
        self._is_configured = False
        return TransitionCallbackReturn.SUCCESS

    def on_shutdown(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Transition: to finalized."""
        return self.on_deactivate(state) if self._is_running else TransitionCallbackReturn.SUCCESS

    def destroy_node(self) -> None:
        """Stop, then destroy the node."""
        if self._is_running:
            self._is_running = False
            self.stop()
        super().destroy_node()

    def _read(self) -> None:
        """Take the parameters as they are now; DataError if they make no sense."""
        read = {each.name: self._declared(each) for each in self.parameters}
        self.values = SimpleNamespace(**read)
        self.read_parameters()
        self.tune(self.values)

    def _declared(self, parameter: Parameter) -> Any:
        """A parameter's value; it is declared with the first look at it."""
        if not self.has_parameter(parameter.name):
            try:
                self.declare_parameter(parameter.name, parameter.default, parameter.descriptor())
            except ParameterException as error:
                raise DataError(f"{parameter.said}: {error}") from error
        return parameter.meant(self.get_parameter(parameter.name).value)

    def _on_parameters(self, changed: list[Given]) -> SetParametersResult:
        rows = {each.name: each for each in (AUTOSTART, HARDWARE, *self.parameters)}
        try:
            asked = {
                each.name: rows[each.name].meant(each.value)
                for each in changed
                if each.name in rows
            }
            if asked and self._is_configured:
                if fixed := sorted(name for name in asked if not rows[name].tunable):
                    raise DataError(f"{', '.join(fixed)}: read when the node is configured")
                values = SimpleNamespace(**vars(self.values) | asked)
                self.tune(values)
                self.values = values
        except (NlsidError, OSError) as refusal:
            return SetParametersResult(successful=False, reason=str(refusal))
        return SetParametersResult(successful=True)

    def _attempt(self, work: Callable[[], None]) -> TransitionCallbackReturn:
        try:
            try:
                work()
            except NameValidationException as error:
                raise unreadable(error) from error
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

    def entities(self) -> list[Any]:
        """Everything the node communicates with, and its timers."""
        kinds = (self.timers, self.subscriptions, self.services, self.clients, self.publishers)
        return [entity for kind in kinds for entity in kind]

    def _destroy_made(self) -> None:
        """Destroy what `start` made; a request that had arrived stays without an answer."""
        made = [each for each in self.entities() if each not in self._made_before]
        destroy: tuple[tuple[list[Any], Callable[[Any], bool]], ...] = (
            (list(self.timers), self.destroy_timer),
            (list(self.subscriptions), self.destroy_subscription),
            (list(self.services), self.destroy_service),
            (list(self.clients), self.destroy_client),
            (list(self.publishers), self.destroy_publisher),
        )
        for entities, remove in destroy:
            for entity in entities:
                if entity in made:
                    entity.callback = entity.send_response = _let_go
                    remove(entity)


def now_ns(clock: Clock) -> int:
    """What a clock says, without rclpy's Time: that costs several times the question."""
    return int(clock.handle.get_now().nanoseconds)


def arm(timer: Timer, ahead_ns: int) -> None:
    """Have a timer call back after so many ns, and again, until it is cancelled."""
    timer.timer_period_ns = ahead_ns
    timer.reset()


def _let_go(*_given: object) -> None:
    """In the place of a destroyed entity's callback: EventsExecutor still calls it for what it had
    queued before.
    """


def unreadable(error: Exception) -> DataError:
    """What ROS cannot use of arguments or names, and why, without where its code says so."""
    said = str(error).partition(", at /")[0].removesuffix(". Error: error not set")
    hint = "; a namespace begins with a slash: /robot1" if "__ns" in said else ""
    return DataError(f"ROS refuses: {' '.join(said.split())}{hint}")
