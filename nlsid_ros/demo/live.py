"""The live demonstration: recorder, publisher, monitor and player as processes over real DDS.

A recorded trial is played in real time twice, as it is and with a broken sensor. What the nodes
did, the recorder has in its bags; it is compared with the offline replay. Run by `nlsid demo`.

python -m nlsid_ros.demo.live --funnel DIR/funnel.json --bag BAG --out DIR
"""

import argparse
import os
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any, NamedTuple

import rclpy

from bags.chain.faults import FAULTS, write_faulty_copy
from bags.designs.documents import load
from bags.designs.wiring import sampler_of
from bags.monitoring.replay import Replay, replay_bag
from bags.recordings.bag import Bag
from bags.recordings.message_types import decode, header_stamp_ns
from nlsid_core.errors import NlsidError
from nlsid_core.running.comparison import Centre
from nlsid_core.running.reading import Status
from nlsid_ros.processes import isolate, python, settings

FAULT = "scaled by 0.6"
QUIET = "fatal"  # what goes wrong is in the outcome; a node that cannot start says so anyhow
PATIENCE = 120.0  # s for nodes to find each other, on a loaded machine
SETTLE = 1.0  # s for the last messages of a pass
MARGIN_TOLERANCE = 1e-9
MARGINS, DIAGNOSTICS = "/funnel_monitor/margin", "/diagnostics"
ERROR = 2  # a DiagnosticStatus's level


class Outcome(NamedTuple):
    """Whether something came out as it should, and a line about it."""

    passed: bool
    said: str


def run_live(funnel: Path, bag: Path, out: Path) -> list[Outcome]:
    """Play `bag` to the live nodes, clean and with a broken sensor, and compare with offline."""
    design = load(funnel)
    faulty = out / f"{bag.name}, {FAULT}"
    response = sampler_of(design).responses[0].path
    write_faulty_copy(bag, faulty, str(response), FAULTS[FAULT])
    bad = replay_bag(design, faulty, centre=Centre.COMMAND)
    if bad.first_bad is None:
        raise NlsidError(
            f"{bag.name} with its sensor {FAULT} is not flagged: {bad.reason or bad.verdict}. The "
            "demonstration needs a funnel that such a fault leaves"
        )
    topics = list(sampler_of(design).topics)
    first, second = (play(funnel, each, topics, out) for each in (bag, faulty))
    return [
        recorded(bag, first, topics),
        monitored(first, replay_bag(design, bag, centre=Centre.COMMAND)),
        alarmed(second, response.topic, bad),
    ]


def play(funnel: Path, bag: Path, topics: list[str], out: Path) -> Path:
    """Play `bag` to publisher, monitor and recorder, and return the recording.

    Raises NlsidError if the nodes do not find each other.
    """
    recording = out / f"{bag.name}, recorded"
    nodes: list[tuple[str, dict[str, Any]]] = [
        ("trajectory_recorder", {"bag": recording, "topics": [*topics, MARGINS, DIAGNOSTICS]}),
        ("funnel_publisher", {"funnel": funnel}),
        ("funnel_monitor", {"allow_old_stamps": True}),
    ]
    given = {"bag": bag, "topics": topics, "wait_for": 2, "wait_timeout": PATIENCE}
    with ExitStack() as stack:
        for name, parameters in nodes:
            stack.enter_context(python(f"nlsid_ros.{name}", settings(parameters, QUIET)))
        rclpy.init()
        stack.callback(rclpy.shutdown)
        listening = rclpy.create_node("live_observer").count_subscribers
        _wait(lambda: bool(listening(MARGINS)))
        player = stack.enter_context(python("nlsid_ros.bag_player", settings(given, QUIET)))
        _wait(lambda: player.poll() is not None)
        if player.returncode:
            raise NlsidError(f"bag_player ended with status {player.returncode}")
        time.sleep(SETTLE)
    return recording


def _wait(done: Callable[[], bool]) -> None:
    """Until it is done; NlsidError if that takes too long."""
    deadline = time.monotonic() + 2.0 * PATIENCE
    while not done():
        if time.monotonic() > deadline:
            raise NlsidError(
                f"waited {2.0 * PATIENCE:g} s for the nodes, in vain. {os.getloadavg()[0]:.0f} "
                f"processes want {os.cpu_count()} processors now: on a busy computer repeat this, "
                "or see that DDS reaches this computer's own processes"
            )
        time.sleep(0.02)


def recorded(bag: Path, recording: Path, topics: list[str]) -> Outcome:
    """Whether topic, stamp and bytes of every message are what was sent."""
    contents = []
    for each in (bag, recording):
        with Bag(each) as source:
            messages = source.messages(topics)
            contents.append(sorted((m.topic, header_stamp_ns(m.data), m.data) for m in messages))
    sent, kept = contents
    said = "equal to what was sent" if sent == kept else "NOT what was sent"
    return Outcome(sent == kept, f"recorder: {len(kept)} of {len(sent)} messages, {said}")


def monitored(recording: Path, replay: Replay) -> Outcome:
    """Whether the margins that the monitor published are those of the replay."""
    heard = {header_stamp_ns(data): m.position[0] for _, data, m in _decoded(recording, MARGINS)}
    pairs = zip(replay.stamps_ns, replay.readings, strict=True)
    judged = {stamp: r.margin for stamp, r in pairs if r.status is not Status.UNKNOWN}
    apart = [abs(heard[stamp] - margin) for stamp, margin in judged.items() if stamp in heard]
    most = max(apart, default=float("nan"))
    said = f"{len(apart)} of {len(judged)} margins, at most {most:.1e} from the offline replay's"
    return Outcome(len(apart) == len(judged) and most <= MARGIN_TOLERANCE, f"monitor: {said}")


def alarmed(recording: Path, topic: str, bad: Replay) -> Outcome:
    """Whether the monitor's first alarm has the replay's reason.

    Its ms are from the first bad sample to ERROR on /diagnostics, both as they came to the
    recorder; slightly negative when the alarm overtakes the sample on its way there.
    """
    assert bad.first_bad is not None
    stamp_ns = bad.stamps_ns[bad.readings.index(bad.first_bad)]
    came_ns = {header_stamp_ns(data): log_ns for log_ns, data, _ in _decoded(recording, topic)}
    for log_ns, _, message in _decoded(recording, DIAGNOSTICS):
        [status] = message.status
        if status.name.partition(":")[0] == "funnel_monitor" and status.level == ERROR:
            ms = (log_ns - came_ns[stamp_ns]) / 1e6
            said = f"ERROR {ms:.1f} ms after the first bad sample ({status.message})"
            return Outcome(bad.reason in status.message, f"sensor {FAULT}: {said}")
    return Outcome(False, f"sensor {FAULT}: no alarm")


def _decoded(recording: Path, topic: str) -> Iterator[tuple[int, bytes, Any]]:
    """(arrival in ns, bytes, message) of every message on a topic."""
    with Bag(recording) as bag:
        msgtype, types = bag.types_on(topic)
        for message in bag.messages([topic]):
            yield message.log_time_ns, message.data, decode(message.data, msgtype, types)


def main(args: list[str] | None = None) -> None:
    """Run once; status 0 if live and offline agree and the alarm came."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--funnel", type=Path, required=True, help="funnel.json, proof beside it")
    parser.add_argument("--bag", type=Path, required=True, help="the trial to play")
    parser.add_argument("--out", type=Path, required=True, help="folder for the recordings")
    options = parser.parse_args(args)
    isolate()
    try:
        outcomes = run_live(options.funnel, options.bag, options.out)
    except (NlsidError, OSError) as error:
        sys.exit(f"live: {error}")
    for outcome in outcomes:
        print(outcome.said)
    sys.exit(0 if all(outcome.passed for outcome in outcomes) else 1)


if __name__ == "__main__":
    main()
