"""A shipped launch file without ROS launch: its nodes as processes, started and ended together.

`launch/*.launch.xml` is what `ros2 launch` reads, so that each workflow is written down once. Of
its language this knows what those files use: arg, node, param, remap, `$(var NAME)`, `$(dirname)`
and `if`.
"""

import ctypes
import os
import re
import signal
import subprocess
import sys
import threading
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from xml.etree import ElementTree
from xml.etree.ElementTree import Element

from bags.chain.shipped import shipped_file
from nlsid_core.errors import DataError

WORKFLOWS = ("monitor", "record", "control", "excite", "identify")  # that `nlsid run` lists
LOOK = 0.2  # s between looks at whether all still run
RESPAWN_DELAY = 1.0  # s, as in the launch files
PATIENCE = 20.0  # s for a node to end when asked to
STOP_SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
PR_SET_PDEATHSIG = 1  # of <sys/prctl.h>
_VARIABLE = re.compile(r"\$\(var (\w+)\)")


@dataclass(frozen=True)
class Argument:
    """What a launch file can be told; default None: it has to be."""

    name: str
    default: str | None
    description: str


class LaunchFile:
    """One workflow's arguments and nodes. Raises DataError if the file uses more than is known."""

    def __init__(self, path: Path) -> None:
        self.path = path
        root = ElementTree.parse(path).getroot()
        self.arguments = [
            Argument(arg.attrib["name"], arg.get("default"), arg.get("description", ""))
            for arg in root.iter("arg")
        ]
        self._nodes = list(root.iter("node"))
        unknown = {child.tag for child in root} - {"arg", "node"}
        unknown |= {child.tag for node in self._nodes for child in node} - {"param", "remap"}
        if unknown:
            raise DataError(f"{path}: <{'>, <'.join(sorted(unknown))}> is for `ros2 launch` only")

    def commands(self, given: Sequence[str]) -> list[list[str]]:
        """A command line per node, for arguments written NAME:=VALUE.

        /TOPIC:=NAME renames a topic for every node, as <set_remap> does. Raises DataError if an
        argument is not known or a necessary one is missing.
        """
        renamed = [text for text in given if text.startswith("/") and ":=" in text]
        values = self._values([text for text in given if text not in renamed])
        wanted = (n for n in self._nodes if _filled(n.get("if", "true"), values).lower() == "true")
        settings = [part for text in renamed for part in ("-r", text)]
        return [[*_command(node, values), *settings] for node in wanted]

    def _values(self, given: Sequence[str]) -> dict[str, str]:
        values = {a.name: a.default for a in self.arguments}
        for text in given:
            name, assigned, value = text.partition(":=")
            if not assigned or name not in values:
                raise DataError(f"'{text}' is not one of the arguments of {self}")
            values[name] = value
        found = {name: value for name, value in values.items() if value is not None}
        found = {n: v.replace("$(dirname)", str(self.path.parent)) for n, v in found.items()}
        missing = values.keys() - found.keys()
        if missing:
            raise DataError(f"{', '.join(sorted(missing))} missing; the arguments of {self}")
        return found

    def __str__(self) -> str:
        lines = [
            f"  {a.name}:={'...' if a.default is None else a.default}  {a.description}"
            for a in self.arguments
        ]
        return "\n".join([f"{self.path.name}:", *lines])


def launch_file(workflow: str) -> LaunchFile:
    """The shipped launch file of a workflow; DataError if it was not installed."""
    return LaunchFile(shipped_file("launch", f"{workflow}.launch.xml"))


def run_together(commands: Sequence[Sequence[str]], *, respawn: bool = False) -> int:
    """Run until a stop signal or until one ends, then end all; the worst of their exit statuses.

    That a node was ended by the signal that asks it to end is no failure.

    respawn: one that fails is started again, RESPAWN_DELAY later. On Linux they also end when this
    process is killed, by SIGTERM as if each had been asked to.
    """
    asked = threading.Event()
    before = {
        number: signal.signal(number, lambda *_: asked.set())
        for number in STOP_SIGNALS
        if number is not signal.SIGHUP or signal.getsignal(number) is not signal.SIG_IGN  # nohup
    }
    running: list[subprocess.Popen[bytes]] = []
    try:
        ending = _end_with(os.getpid())
        running += [subprocess.Popen(command, preexec_fn=ending) for command in commands]
        while not asked.is_set():
            ended = [k for k, process in enumerate(running) if process.poll() is not None]
            if ended and not (respawn and all(running[k].returncode for k in ended)):
                break
            asked.wait(RESPAWN_DELAY if ended else LOOK)
            for k in () if asked.is_set() else ended:
                running[k] = subprocess.Popen(commands[k], preexec_fn=ending)
    finally:
        for process in running:
            if process.poll() is None:
                process.send_signal(signal.SIGINT)
        for process in running:
            try:
                process.wait(timeout=PATIENCE)
            except subprocess.TimeoutExpired:
                process.kill()
        for number, handler in before.items():
            signal.signal(number, handler)
    statuses = [process.wait() for process in running]
    return max((abs(each) for each in statuses if each != -signal.SIGINT), default=0)


def _end_with(parent: int) -> Callable[[], None] | None:
    """What a new process does so that it gets SIGTERM when its parent is gone; Linux only.

    SIGINT waits until the node is ready for it: Python ends an import with a traceback.
    """
    if not sys.platform.startswith("linux"):
        return None
    prctl = ctypes.CDLL(None).prctl

    def ask() -> None:
        signal.pthread_sigmask(signal.SIG_BLOCK, [signal.SIGINT])
        prctl(PR_SET_PDEATHSIG, signal.SIGTERM)
        if os.getppid() != parent:  # it was gone before
            os.kill(os.getpid(), signal.SIGTERM)

    return ask


def _command(node: Element, values: Mapping[str, str]) -> list[str]:
    def filled(element: Element, attribute: str) -> str:
        return _filled(element.attrib[attribute], values)

    namespace = "/" + filled(node, "namespace").strip("/")  # as ROS launch takes `robot1`
    renamed = [("__node", filled(node, "name")), ("__ns", namespace)]
    renamed += [(filled(each, "from"), filled(each, "to")) for each in node.iter("remap")]
    settings = filled(node, "ros_args").split()
    settings += [part for old, new in renamed for part in ("-r", f"{old}:={new}")]
    for each in node.iter("param"):
        if "from" in each.attrib:
            settings += ["--params-file", filled(each, "from")]
        else:
            settings += ["-p", f"{filled(each, 'name')}:={filled(each, 'value')}"]
    return [sys.executable, "-m", f"nlsid_ros.{filled(node, 'exec')}", "--ros-args", *settings]


def _filled(text: str, values: Mapping[str, str]) -> str:
    return _VARIABLE.sub(lambda match: values[match[1]], text)
