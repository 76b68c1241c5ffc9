"""Which machine a figure was measured on."""

import os
import platform
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path


def describe() -> str:
    """The processor's name, how many cores this process may use, and Python's version."""
    name = platform.processor() or platform.machine()
    cpuinfo = Path("/proc/cpuinfo")
    if cpuinfo.is_file():
        models = [
            line for line in cpuinfo.read_text().splitlines() if line.startswith("model name")
        ]
        name = models[0].partition(":")[2].strip() if models else name
    threads = os.environ.get("OMP_NUM_THREADS", "all")
    return f"{name}, {threads} thread(s), Python {platform.python_version()}"


def peers(*distributions: str) -> dict[str, dict[str, str]]:
    """{"peers": {distribution: version}} of what ours is measured beside, for the JSON result."""
    versions = {}
    for name in distributions:
        try:
            versions[name] = version(name)
        except PackageNotFoundError:
            versions[name] = "not installed"
    return {"peers": versions}
