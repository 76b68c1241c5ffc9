"""What every test over DDS needs, a ROS domain of its own, and what most do."""

from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import pytest

from tests.ros.domains import own_domain


@pytest.fixture(autouse=True)
def domain() -> Iterator[None]:
    with own_domain():
        yield


@pytest.fixture
def stack() -> Iterator[ExitStack]:
    """Ends what a test started."""
    with ExitStack() as stack:
        yield stack


@pytest.fixture
def bench(stack: ExitStack) -> Any:
    """A node beside those that a test starts."""
    from tests.ros.processes import Bench  # where ROS is there

    return Bench(stack)


@pytest.fixture
def robot(stack: ExitStack, funnel: Path) -> Any:
    """A car that the test drives, and its funnel, latched."""
    from tests.ros.robot import Robot

    return Robot(stack, funnel.parent)
