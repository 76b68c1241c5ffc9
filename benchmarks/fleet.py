"""A fleet of bags behind an S3 server of this machine: how fast it is read, and what is fetched.

python -m benchmarks.fleet [--bags 200] [--kills 4] [--json]

The bags are made of the shipped F1TENTH trials with noise of their own on the speed, and with eight
more topics, among them a camera: 1.9 MB each, chunks of 768 KiB without compression, as `ros2 bag
record` writes them. Wanted are speed and command. The server is moto's, in a process of its own on
the same cores, which keeps its objects on the disk: 2.1 MB a bag, in the cache folder until it
ends. What is done is said on standard error. By hand is what one writes with s3fs, rosbags and
Dask: fetch the file, decode the two topics, interpolate.
"""

import argparse
import hashlib
import multiprocessing
import os
import random
import resource
import signal
import sqlite3
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import ProcessPoolExecutor
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, replace
from io import BytesIO
from itertools import cycle, islice
from pathlib import Path
from typing import Any

import boto3
import numpy as np
from mcap.writer import CompressionType, Writer

from bags.chain.config import load_config
from bags.fleet.bags import named_bags
from bags.fleet.manifest import Manifest
from bags.fleet.run import Answer, ask
from bags.fleet.trials import ReadTrials
from bags.fleet.workers import Workers
from bags.recordings.bag import Bag
from bags.recordings.definitions import standard_definition
from bags.recordings.message_types import decode, standard_types
from bags.samples import f1tenth
from benchmarks.cache import cache_folder
from benchmarks.machine import parser, tell
from examples.fleet.__main__ import free_port, started

BUCKET = "fleet"
CONFIG = Path(__file__).resolve().parents[1] / "config" / "f1tenth.yaml"
IMAGES, IMAGE_BYTES = 15, 120_000  # of one bag
OTHERS = 7  # small topics, of ten messages each
CHUNK = 768 * 2**10
NOISE = 1e-3  # m/s
MANY = 1000  # bags, at most, that one worker reads, and that are read by hand
BLOB = "std_msgs/msg/ByteMultiArray"
FILES = 1000  # that are open besides those of the server, one an object
SPEED, COMMAND = "/odom:twist.twist.linear.x", "/cmd_vel:twist.linear.x"


def say(what: str) -> None:
    """What is done, and when, for who waits."""
    print(f"{time.strftime('%H:%M:%S')} {what}", file=sys.stderr, flush=True)


@contextmanager
def scratch(bags: int) -> Iterator[Path]:
    """A folder for the server's objects and everything else, which is gone at the end.

    Raises ValueError if the server may not have so many files open at a time.
    """
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    resource.setrlimit(resource.RLIMIT_NOFILE, (max(soft, bags + FILES), hard))
    with tempfile.TemporaryDirectory(dir=cache_folder(), prefix="fleet-") as name:
        os.environ |= {"TMPDIR": name, "MOTO_S3_DEFAULT_KEY_BUFFER_SIZE": "1"}
        tempfile.tempdir = name
        yield Path(name)


def made_bag(trial: Path, seed: int) -> bytes:
    """The trial as one MCAP file, with noise on the speed and with the other topics."""
    rng = np.random.default_rng(seed)
    stream = BytesIO()
    writer = Writer(stream, chunk_size=CHUNK, compression=CompressionType.NONE)
    writer.start(profile="ros2")
    channels: dict[str, int] = {}

    def add(topic: str, kind: str, at: int, data: bytes) -> None:
        if topic not in channels:
            text = standard_definition(kind).text.encode()
            channels[topic] = writer.register_channel(
                topic, "cdr", writer.register_schema(kind, "ros2msg", text)
            )
        writer.add_message(channels[topic], at, data, at)

    with Bag(trial) as bag:
        messages = list(bag.messages())
        types = {topic: bag.types_on(topic) for topic in bag.topics}
    every = max(1, len(messages) // IMAGES)
    for k, message in enumerate(messages):
        data = message.data
        if message.topic == "/odom":
            odometry: Any = decode(data, *types["/odom"])
            odometry.twist.twist.linear.x += NOISE * rng.standard_normal()
            data = bytes(standard_types().serialize_cdr(odometry, message.msgtype))
        add(message.topic, message.msgtype, message.log_time_ns, data)
        if k % every == 0:
            add("/camera", BLOB, message.log_time_ns, b"\0\1\0\0" + rng.bytes(IMAGE_BYTES))
        if k % (2 * every) == 0:
            for i in range(OTHERS):
                add(f"/other_{i}", BLOB, message.log_time_ns, b"\0\1\0\0" + rng.bytes(200))
    writer.finish()
    return stream.getvalue()


@contextmanager
def s3_server(folder: Path) -> Iterator[Any]:
    """moto's server in a process of its own; yields a client of it."""
    port = free_port()
    os.environ |= {
        "AWS_ACCESS_KEY_ID": "benchmark",
        "AWS_SECRET_ACCESS_KEY": "benchmark",
        "AWS_DEFAULT_REGION": "us-east-1",
        "AWS_ENDPOINT_URL": f"http://127.0.0.1:{port}",
    }
    command = ["-m", "moto.server", "-H", "127.0.0.1", "-p", str(port)]
    with started(command, port, folder / "server.log"):
        client = boto3.client("s3")
        client.create_bucket(Bucket=BUCKET)
        yield client


def fill(client: Any, count: int) -> int:
    """Put so many bags into the bucket; their bytes."""
    size = 0
    for k, trial in enumerate(islice(cycle(f1tenth()), count)):
        content = made_bag(trial, k)
        key = f"plain/robot_{k % 10}/drive_{k:05d}.mcap"
        client.put_object(Bucket=BUCKET, Key=key, Body=content)
        size += len(content)
    say(f"{count} bags made")
    return size


@dataclass(frozen=True)
class Read:
    """Answers without what they say: sent has its bytes, digest is of all of it in order.

    bags_per_s: between the first answer and the last.
    """

    answers: list[Answer]
    bags_per_s: float
    digest: str
    sent: int


def read(bags: Mapping[str, Path], workers: int, manifest: Path | None = None) -> Read:
    """What a command that keeps a row for each bag reads of them."""
    came: list[float] = []

    def note(what: str, part: float) -> None:
        came.append(time.monotonic())
        if len(came) % max(1, len(bags) // 10) == 0:
            say(f"  {what} ({part:.0%})")

    answers: list[Answer] = []
    said, sent = hashlib.sha256(), 0
    with Manifest(manifest) as kept:
        for answer in ask(
            ReadTrials(load_config(CONFIG)),
            bags,
            Workers(workers),
            kept,
            progress=note,
        ):
            if answer.reason:
                raise RuntimeError(f"{answer.name}: {answer.reason}")
            said.update(answer.content)
            sent += len(answer.content)
            answers.append(replace(answer, content=b""))
    rate = (len(came) - 1) / (came[-1] - came[0]) if len(came) > 1 else float("nan")
    return Read(answers, rate, said.hexdigest(), sent)


@dataclass(frozen=True)
class Alone:
    """Of a process that reads bags by itself and keeps what they say: its most memory, its
    processor time a bag, a digest of the answers, and what was fetched and sent home of all.
    """

    peak_mb: float
    cpu_ms: float
    digest: str = ""
    requests: int = 0
    fetched: int = 0
    sent: int = 0


def alone(reader: Callable[[str], Alone], pattern: str) -> Alone:
    """`reader`, `_ours` or `_theirs`, in a process of its own."""
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(max_workers=1, mp_context=context) as pool:
        return pool.submit(reader, pattern).result()


def _ours(pattern: str) -> Alone:
    read(dict(islice(named_bags([Path(pattern)]).items(), 1)), 0)  # so that imports do not count
    bags: dict[str, Any] = {**named_bags([Path(pattern)])}
    started = time.process_time()
    found = read(bags, 0)
    cpu = time.process_time() - started
    return Alone(
        resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024,
        1e3 * cpu / len(bags),
        found.digest,
        sum(bag.requests + 1 for bag in bags.values()),  # and whether it has changed
        sum(bag.fetched for bag in bags.values()),
        found.sent,
    )


def _theirs(pattern: str) -> Alone:
    urls = [str(path) for path in named_bags([Path(pattern)]).values()][:MANY]
    _by_hand(urls[0])
    started = time.process_time()
    for url in urls:
        _by_hand(url)
    cpu = time.process_time() - started
    return Alone(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024, 1e3 * cpu / len(urls))


def by_hand(bags: Mapping[str, Path], workers: int) -> float:
    """Bags a second of the script that one would write."""
    from distributed import Client, LocalCluster, as_completed

    with (
        LocalCluster(n_workers=workers, threads_per_worker=1, dashboard_address=None) as cluster,
        Client(cluster) as client,
    ):
        futures = client.map(_by_hand, [str(path) for path in bags.values()], pure=False)
        came = []
        for future in as_completed(futures):
            assert len(future.result()) == 3
            came.append(time.monotonic())
    return (len(came) - 1) / (came[-1] - came[0])


def _by_hand(url: str) -> tuple[Any, Any, Any]:
    import s3fs
    from rosbags.highlevel import AnyReader

    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "drive.mcap"
        s3fs.S3FileSystem().get(url, str(file))
        found: dict[str, list[tuple[float, float]]] = {"/odom": [], "/cmd_vel": []}
        with AnyReader([file]) as reader:
            wanted = [c for c in reader.connections if c.topic in found]
            for connection, stamp, data in reader.messages(wanted):
                message: Any = reader.deserialize(data, connection.msgtype)
                twist = message.twist.twist if connection.topic == "/odom" else message.twist
                found[connection.topic].append((stamp / 1e9, twist.linear.x))
    (t, y), (s, u) = (np.array(found[topic]).T for topic in ("/odom", "/cmd_vel"))
    grid = np.arange(t[0], t[-1], 0.025)
    return grid, np.interp(grid, t, y), np.interp(grid, s, u)


def killed(pattern: str, wanted: str, rounds: int, folder: Path) -> int:
    """In how many rounds a run that is killed, client or worker, ends as one that is not."""
    good = 0
    for number in range(rounds):
        say(f"killing a {'client' if number % 2 else 'worker'}: {number + 1} of {rounds}")
        manifest = folder / f"killed_{number}.sqlite"
        command = [sys.executable, "-m", "benchmarks.fleet", "--once", pattern, str(manifest)]
        run = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        limit = time.monotonic() + 60.0
        while not _rows(manifest) and time.monotonic() < limit:
            time.sleep(0.02)
        time.sleep(random.uniform(0.0, 0.5))
        victims = [run.pid] if number % 2 else _children(run.pid)
        for victim in victims[-1:]:
            os.kill(victim, signal.SIGKILL)
        run.wait()
        if number % 2:
            done = subprocess.run(command, capture_output=True, text=True, check=True)
            good += done.stdout.strip().endswith(wanted)
        else:
            found = read(named_bags([Path(pattern)]), 0, manifest)
            good += found.digest == wanted and all(answer.kept for answer in found.answers)
    return good


def _children(pid: int) -> list[int]:
    """Processes that it started and that read bags; the resource tracker is not one."""
    there = Path(f"/proc/{pid}/task/{pid}/children").read_text().split()
    return [int(c) for c in there if b"spawn_main" in Path(f"/proc/{c}/cmdline").read_bytes()]


def _rows(manifest: Path) -> int:
    """How many bags it has; none before it is there."""
    try:
        with sqlite3.connect(f"file:{manifest}?mode=ro", uri=True) as rows:
            return int(rows.execute("select count(*) from bags").fetchone()[0])
    except sqlite3.OperationalError:
        return 0


def measured(count: int, kills: int) -> dict[str, Any]:
    """Everything, by the keys of the JSON."""
    with ExitStack() as stack:
        folder = stack.enter_context(scratch(count))
        client = stack.enter_context(s3_server(folder))
        size = fill(client, count)
        pattern = f"s3://{BUCKET}/plain/*/drive_*.mcap"
        bags = named_bags([Path(pattern)])
        many = dict(islice(bags.items(), MANY))
        tenth = f"s3://{BUCKET}/plain/robot_0/drive_*.mcap"
        say("a tenth of the bags by one process, then all")
        fewer, here = alone(_ours, tenth), alone(_ours, pattern)
        say(f"{len(many)} bags by one worker, all by two")
        one, two = read(many, 1).bags_per_s, read(bags, 2)
        say(f"{len(many)} bags by hand, by two workers of Dask; a tenth by one process")
        hand, hand_cpu = by_hand(many, 2), alone(_theirs, tenth).cpu_ms
        part_of_all = f"s3://{BUCKET}/plain/robot_0/drive_00*.mcap"  # one folder to be listed
        wanted = read(named_bags([Path(part_of_all)]), 0).digest
        good = killed(part_of_all, wanted, kills, folder)
        return {
            "bags": count,
            "megabytes": round(size / 1e6, 1),
            "bags_per_s": {"1": round(one, 2), "2": round(two.bags_per_s, 2)},
            "bytes_fetched_share": round(here.fetched / size, 4),
            "requests_per_bag": round(here.requests / count, 2),
            "bytes_sent_home_per_bag": round(here.sent / count),
            "peak_mb": {
                str(-(-count // 10)): round(fewer.peak_mb, 1),
                str(count): round(here.peak_mb, 1),
            },
            "cpu_ms_per_bag": round(here.cpu_ms, 2),
            "bit_equal": two.digest == here.digest,
            "resumed_after_kills": f"{good} of {kills}",
            "by_hand_bags_per_s": round(hand, 2),
            "by_hand_cpu_ms_per_bag": round(hand_cpu, 2),
            "ratio_to_by_hand": round(two.bags_per_s / hand, 2),
            "cpu_ratio_to_by_hand": round(hand_cpu / here.cpu_ms, 2),
        }


def main() -> None:
    """Make the fleet, read it, say how that went."""
    options = parser(__doc__)
    options.add_argument("--bags", type=int, default=200)
    options.add_argument("--kills", type=int, default=4, help="runs that are killed half-way")
    options.add_argument("--once", nargs=2, metavar=("PATTERN", "MANIFEST"), help=argparse.SUPPRESS)
    arguments = options.parse_args()
    if arguments.once:
        pattern, manifest = arguments.once
        print(read(named_bags([Path(pattern)]), 2, Path(manifest)).digest)
        return
    signal.signal(signal.SIGTERM, lambda *_: sys.exit("ended"))  # so that nothing stays behind
    tell(measured(arguments.bags, arguments.kills), as_json=arguments.json)


if __name__ == "__main__":
    main()
