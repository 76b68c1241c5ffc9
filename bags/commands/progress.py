"""A progress bar on standard error, as a callback for the steps."""

import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager

from nlsid_core.progress import Progress, silent

PATIENCE = 1.0  # s


@contextmanager
def progress_bar(task: str) -> Iterator[Progress]:
    """Yield `progress(what, fraction)`; the bar disappears when the work is done.

    It is shown only to a terminal, and only of work that takes longer than PATIENCE.
    """
    if not sys.stderr.isatty():
        yield silent
        return
    from rich.console import Console
    from rich.progress import BarColumn, SpinnerColumn, TextColumn, TimeElapsedColumn
    from rich.progress import Progress as Bar

    started = time.monotonic()
    columns = (SpinnerColumn(), BarColumn(), TimeElapsedColumn(), TextColumn("{task.description}"))
    console = Console(stderr=True)
    bar = Bar(*columns, console=console, transient=True)
    identifier = bar.add_task(task, total=1.0)

    def show(what: str, fraction: float) -> None:
        if time.monotonic() - started >= PATIENCE:
            bar.start()
            bar.update(identifier, description=what, completed=fraction)

    try:
        yield show
    finally:
        bar.stop()
