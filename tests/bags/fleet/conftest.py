"""An S3 server of this machine for the tests, which are skipped without the extra `fleet`."""

import logging
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

try:
    import obstore  # noqa: F401
except ImportError:
    collect_ignore = ["test_remote.py"]


class Bucket:
    """A bucket that tests put files into."""

    def __init__(self, client: Any, name: str) -> None:
        self._client, self.name = client, name
        client.create_bucket(Bucket=name)

    def put(self, file: Path, key: str) -> str:
        """Upload; returns the URL."""
        self._client.put_object(Bucket=self.name, Key=key, Body=file.read_bytes())
        return f"s3://{self.name}/{key}"

    def remove(self, key: str) -> None:
        self._client.delete_object(Bucket=self.name, Key=key)


@pytest.fixture(scope="session")
def s3() -> Iterator[Any]:
    """A client of moto's server; obstore finds the server by the environment."""
    moto = pytest.importorskip("moto.server")
    boto3 = pytest.importorskip("boto3")
    pytest.importorskip("obstore")
    logging.getLogger("werkzeug").setLevel(logging.ERROR)
    server = moto.ThreadedMotoServer(port=0, verbose=False)
    server.start()
    _, port = server.get_host_and_port()
    settings = {
        "AWS_ACCESS_KEY_ID": "test",
        "AWS_SECRET_ACCESS_KEY": "test",
        "AWS_DEFAULT_REGION": "us-east-1",
        "AWS_ENDPOINT_URL": f"http://127.0.0.1:{port}",
    }
    with pytest.MonkeyPatch.context() as patch:
        for key, value in settings.items():
            patch.setenv(key, value)
        yield boto3.client("s3")
    server.stop()


@pytest.fixture
def bucket(s3: Any, request: pytest.FixtureRequest) -> Bucket:
    """A bucket of the test's own."""
    name = "b" + format(abs(hash(request.node.nodeid)), "x")
    return Bucket(s3, name)
