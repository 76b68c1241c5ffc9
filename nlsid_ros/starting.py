"""How every node starts and ends: its `main`, the signals that stop it, and its watchdog."""

import gc
import inspect
import os
import signal
import socket
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager

import rclpy
from rclpy.experimental.events_executor import EventsExecutor
from rclpy.signals import SignalHandlerOptions
from rclpy.utilities import try_shutdown

from nlsid_core.errors import NlsidError
from nlsid_ros import shared_memory, watchdog
from nlsid_ros.running import ManagedNode, unreadable

STOP_SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)


def entry_point(node: type[ManagedNode]) -> Callable[..., None]:
    """Make the `main` of `ros2 run nlsid NAME`; it ends with status 1 and a line if it fails."""

    def main(args: list[str] | None = None) -> None:
        try:
            run(node, args)
        except (NlsidError, OSError) as error:
            sys.exit(f"{node.name}: {error}")

    return main


def run(make: Callable[[], ManagedNode], args: list[str] | None) -> None:
    """Make the node, start it if it starts itself, and spin until it is over, or until SIGINT,
    SIGTERM or SIGHUP (a terminal that is closed, unless `nohup` says that it does not matter).

    The signals are waited for here and not left to rclpy, which would end all communication before
    the node could send a last command. Raises what made the node fail.
    """
    woken = _wake_on_signals()
    shared_memory.avoid_what_is_stale()
    try:
        rclpy.init(args=args, signal_handler_options=SignalHandlerOptions.NO)
    except RuntimeError as error:
        raise unreadable(error) from error
    with ExitStack() as ending:  # communication ends, also if the node cannot be stopped
        ending.callback(try_shutdown)
        node = make()
        ending.callback(node.destroy_node)
        if node.autostart:
            node.start_itself()
        inspect.getframeinfo(sys._getframe())  # as rclpy does to log: the first takes 0.05 s
        gc.collect()
        gc.freeze()  # what is here stays: no collection has to look through it in mid-stream
        with _watched(node):
            _spin(node, woken)


@contextmanager
def _watched(node: ManagedNode) -> Iterator[None]:
    """A watchdog beside this process, in a session of its own, where Ctrl-C does not reach it."""
    if not node.is_watched:
        yield
        return
    command = [sys.executable, "-I", "-S", watchdog.__file__, str(os.getpid()), node.get_name()]
    with subprocess.Popen(command, stdin=subprocess.DEVNULL, start_new_session=True) as watching:
        try:
            yield
        finally:
            watching.kill()


def _spin(node: ManagedNode, woken: socket.socket) -> None:
    """Spin until a signal came, and what had arrived by then is handed on; or until it is over.

    By `spin_once` with a timeout: without one the executor hears nothing. Raises what made the node
    fail.
    """
    executor = EventsExecutor()
    executor.add_node(node)
    asked = threading.Event()

    def wait() -> None:
        woken.recv(1)
        executor.create_task(asked.set)  # goes to the end of the queue

    threading.Thread(target=wait, daemon=True).start()
    while not (asked.is_set() or node.is_over):
        executor.spin_once(timeout_sec=0.1)
    if node.is_over and node.failure is not None:
        raise node.failure


def _wake_on_signals() -> socket.socket:
    """A socket that gets a byte at once when a stop signal comes, whatever Python is waiting in."""
    receiver, sender = socket.socketpair()
    sender.setblocking(False)
    signal.set_wakeup_fd(sender.detach())
    for number in STOP_SIGNALS:
        if number is not signal.SIGHUP or signal.getsignal(number) is not signal.SIG_IGN:
            signal.signal(number, lambda _number, _frame: None)
    signal.pthread_sigmask(signal.SIG_UNBLOCK, STOP_SIGNALS)  # `nlsid run` starts it deaf to SIGINT
    return receiver
