"""Where benchmarks keep what they generate: folders given with --data are only read."""

import os
from pathlib import Path


def cache_folder() -> Path:
    """`$XDG_CACHE_HOME/nlsid` or `~/.cache/nlsid`; made if it is not there."""
    home = os.environ.get("XDG_CACHE_HOME", "")
    folder = (Path(home) if home else Path.home() / ".cache") / "nlsid"
    folder.mkdir(parents=True, exist_ok=True)
    return folder
