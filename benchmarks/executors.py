"""Which way a stream takes through rclpy: its executor, or the EventsExecutor in its two ways.

python -m benchmarks.executors [--seconds 10] [--json]

A process sends at 1 kHz, one relays each sample, one hears it; only how the relay waits differs.
missed: of the samples sent; latency from sending to hearing; processor time of the relay a sample.
A relay that does not come up within PATIENCE, or does not hear, has no latencies.
"""

import argparse
import json
import math
import os
import subprocess
import sys
import time
from contextlib import suppress

import numpy as np
import rclpy
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.experimental.events_executor import EventsExecutor
from rclpy.node import Node
from sensor_msgs.msg import JointState

from benchmarks.machine import describe, peers
from benchmarks.processes import cpu_seconds, isolate
from nlsid_ros import qos
from nlsid_ros.messages import stamp_ns_of

RATE = 1000  # Hz
SAMPLE, ANSWER = "/benchmark/sample", "/benchmark/answer"
PATIENCE = 20.0  # s for a relay to come up, and to end
WAYS = ("rclpy.spin", "events.spin", "events.spin_once")


def relay(way: str) -> None:
    """Answer every sample, waiting for it in one of WAYS."""
    rclpy.init()
    node = Node("relay")
    answers = node.create_publisher(JointState, ANSWER, qos.STREAM)
    answer = JointState(name=["margin"] * 6, position=[0.0] * 6)

    def on_sample(message: JointState) -> None:
        answer.header.stamp = message.header.stamp
        answers.publish(answer)

    node.create_subscription(JointState, SAMPLE, on_sample, qos.STREAM)
    executor = EventsExecutor() if way.startswith("events") else SingleThreadedExecutor()
    executor.add_node(node)
    with suppress(KeyboardInterrupt, ExternalShutdownException):
        while way == "events.spin_once":
            executor.spin_once(timeout_sec=0.1)
        executor.spin()


def send(seconds: float) -> None:
    """Publish at 1 kHz, each stamped when it is sent; print how many."""
    rclpy.init()
    node = Node("sender")
    samples = node.create_publisher(JointState, SAMPLE, qos.STREAM)
    ended = time.monotonic() + PATIENCE
    while samples.get_subscription_count() < 1 and time.monotonic() < ended:
        time.sleep(0.01)
    time.sleep(0.5)
    count, message, start = round(seconds * RATE), JointState(position=[0.0]), time.perf_counter()
    for k in range(count):
        while (ahead := start + k / RATE - time.perf_counter()) > 0:
            time.sleep(max(ahead - 1e-4, 0.0))
        now_ns = time.time_ns()
        message.header.stamp.sec, message.header.stamp.nanosec = divmod(now_ns, 10**9)
        samples.publish(message)
    time.sleep(1.0)
    print(count)


def measure(way: str, seconds: float, domain: int) -> dict[str, float]:
    """One way, on a domain of its own."""
    os.environ["ROS_DOMAIN_ID"] = str(domain)
    rclpy.init()
    ear, heard = Node("ear"), list[float]()

    def hear(message: JointState) -> None:
        heard.append((time.time_ns() - stamp_ns_of(message)) / 1e6)

    ear.create_subscription(JointState, ANSWER, hear, qos.STREAM)
    executor = EventsExecutor()
    executor.add_node(ear)
    command = [sys.executable, "-m", "benchmarks.executors"]
    relaying = subprocess.Popen([*command, "--relay", way])
    deadline = time.monotonic() + PATIENCE
    while not ear.count_publishers(ANSWER) and time.monotonic() < deadline:
        executor.spin_once(timeout_sec=0.1)
    before = cpu_seconds(relaying.pid)
    sending = subprocess.Popen(
        [*command, "--send", str(seconds)], stdout=subprocess.PIPE, text=True
    )
    while sending.poll() is None:
        executor.spin_once(timeout_sec=0.1)
    cpu = cpu_seconds(relaying.pid) - before
    sent = int(sending.communicate()[0])
    relaying.terminate()
    ended = time.monotonic()
    try:
        relaying.wait(timeout=PATIENCE)
    except subprocess.TimeoutExpired:
        relaying.kill()
        relaying.wait()
    ending = time.monotonic() - ended
    ear.destroy_node()
    rclpy.shutdown()
    p50, p99 = np.percentile(heard, [50, 99]).tolist() if heard else (math.nan, math.nan)
    return {
        "sent": sent,
        "missed": sent - len(heard),
        "latency_ms_p50": p50,
        "latency_ms_p99": p99,
        "cpu_us_per_sample": 1e6 * cpu / sent,
        "seconds_to_end": ending,
    }


def main() -> None:
    """Print the table; with --json the last line is one JSON object."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seconds", type=float, default=10.0)
    parser.add_argument("--json", action="store_true")
    parser.add_argument("--relay", choices=WAYS, help=argparse.SUPPRESS)
    parser.add_argument("--send", type=float, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.relay:
        relay(options.relay)
        return
    if options.send:
        send(options.send)
        return
    isolate()
    first, result = int(os.environ["ROS_DOMAIN_ID"]), {}
    print(describe())
    for number, way in enumerate(WAYS):
        result[way] = measure(way, options.seconds, 1 + (first + number) % 101)
        print(f"{way:18} " + "  ".join(f"{k} {v:.4g}" for k, v in result[way].items()), flush=True)
    if options.json:
        heard = {
            way: {key: value for key, value in of.items() if not math.isnan(value)}
            for way, of in result.items()
        }
        print(json.dumps(heard | peers("ros-jazzy-rclpy")))


if __name__ == "__main__":
    main()
