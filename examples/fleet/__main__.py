"""A fleet on this machine: an S3 server, a Dask scheduler with two workers, and the commands.

python -m examples.fleet [--out DIR]

Puts the shipped F1TENTH trials into a bucket as two cars' drives, one of them cut in half, then
runs `nlsid identify`, `funnel`, `fleet check` and `fleet monitor` as one would on a real fleet:
only the URL and the scheduler's address would be others. Needs `pip install 'nlsid[fleet,test]'`.
"""

import argparse
import os
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

import boto3

from bags.samples import f1tenth

BUCKET = "fleet"
CONFIG = Path(__file__).with_name("robot.yaml")
PATTERN = f"s3://{BUCKET}/*/trial_*.mcap"


@contextmanager
def started(command: list[str], port: int, log: Path) -> Iterator[None]:
    """A process of this Python that listens on a port, until the end of the block."""
    with log.open("w") as stream:
        process = subprocess.Popen([sys.executable, *command], stdout=stream, stderr=stream)
    try:
        for _ in range(600):
            with socket.socket() as probe:
                if probe.connect_ex(("127.0.0.1", port)) == 0:
                    break
            time.sleep(0.1)
        else:
            raise TimeoutError(f"{' '.join(command)} does not answer; see {log}")
        yield
    finally:
        process.terminate()
        process.wait()


def free_port() -> int:
    """A port that nobody listens on."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port: int = probe.getsockname()[1]
        return port


def upload() -> int:
    """The trials as `car_1/trial_01.mcap`, ...; the last is cut in half. Returns their number."""
    client = boto3.client("s3")
    client.create_bucket(Bucket=BUCKET)
    trials = f1tenth()
    for k, trial in enumerate(trials):
        content = next(trial.glob("*.mcap")).read_bytes()
        if k == len(trials) - 1:
            content = content[: len(content) // 2]
        client.put_object(Bucket=BUCKET, Key=f"car_{1 + k % 2}/{trial.name}.mcap", Body=content)
    return len(trials)


def nlsid(*arguments: str) -> int:
    """Run a command of nlsid as a person would; returns its status."""
    print("\n$ nlsid", *arguments, flush=True)
    return subprocess.run([sys.executable, "-m", "bags.commands.main", *arguments]).returncode


def run(out: Path) -> dict[str, int]:
    """Everything; returns the status of each command by name."""
    s3, scheduler = free_port(), free_port()
    address = f"tcp://127.0.0.1:{scheduler}"
    os.environ |= {
        "AWS_ACCESS_KEY_ID": "example",
        "AWS_SECRET_ACCESS_KEY": "example",
        "AWS_DEFAULT_REGION": "us-east-1",
        "AWS_ENDPOINT_URL": f"http://127.0.0.1:{s3}",
    }
    out.mkdir(parents=True, exist_ok=True)
    dask = ["-m", "distributed.cli.dask_scheduler", "--host", "127.0.0.1", "--no-dashboard"]
    worker = ["-m", "distributed.cli.dask_worker", address, "--nworkers", "2", "--nthreads", "1"]
    with ExitStack() as stack:
        servers = (
            (["-m", "moto.server", "-H", "127.0.0.1", "-p", str(s3)], s3, "s3.log"),
            ([*dask, "--port", str(scheduler)], scheduler, "scheduler.log"),
            ([*worker, "--no-dashboard"], scheduler, "workers.log"),
        )
        for command, port, log in servers:
            stack.enter_context(started(command, port, out / log))
        print(f"{upload()} bags in s3://{BUCKET}, scheduler at {address}, logs in {out}")
        by, config = ["--scheduler", address], ["--config", str(CONFIG)]
        return {
            "identify": nlsid("identify", str(out), PATTERN, *config, *by),
            "funnel": nlsid("funnel", str(out), *config),
            "check": nlsid("fleet", "check", str(out), PATTERN, *config, *by),
            "monitor": nlsid("fleet", "monitor", str(out), PATTERN, *config, *by),
        }


def main() -> None:
    """Run it in a folder of its own, or in --out."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, help="folder for what is made; default: a new one")
    options = parser.parse_args()
    statuses = run(options.out or Path(tempfile.mkdtemp(prefix="nlsid-fleet-")))
    print("\nstatus of each command:", statuses)


if __name__ == "__main__":
    main()
