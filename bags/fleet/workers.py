"""Who reads bags: this process, processes of this machine, or a Dask cluster."""

import multiprocessing
import os
import threading
from collections.abc import Callable
from concurrent.futures import (
    Executor,
    Future,
    ProcessPoolExecutor,
)
from dataclasses import dataclass
from typing import Any, Final

from nlsid_core.errors import DataError

AHEAD: Final = 2  # bags that a worker has or waits for
MAX_WORKERS: Final = 512


@dataclass(frozen=True)
class Workers:
    """count: processes of this machine, 0: none but this one. scheduler: of a Dask cluster instead.

    `Workers(8)`, `Workers(scheduler="tcp://host:8786")`. Raises DataError if both are named.
    """

    count: int = 0
    scheduler: str = ""

    def __post_init__(self) -> None:
        if self.count and self.scheduler:
            raise DataError("workers of this machine or a scheduler's: name one of them")
        if not 0 <= self.count <= MAX_WORKERS:
            raise DataError(f"{self.count} workers; 0 to {MAX_WORKERS} can be had")

    def open(self) -> Executor:
        """An executor of them; to be shut down. Raises DataError if the cluster is not there."""
        if self.scheduler:
            return _dask(self.scheduler)
        if self.count:
            spawn = multiprocessing.get_context("spawn")  # obstore's threads do not live in a fork
            pool = ProcessPoolExecutor(self.count, mp_context=spawn, initializer=_end_with_parent)
            for _ in range(self.count):  # all begin now: none while the pool ends for a dead one
                pool.submit(os.getpid)
            return pool
        return _Here()

    def close(self, executor: Executor) -> None:
        """End them, or leave the cluster; what they have not begun is not done."""
        if self.scheduler:
            executor.shutdown(wait=False)
            client: Any = getattr(executor, "_client", None)
            client.close()
        else:
            executor.shutdown(wait=False, cancel_futures=True)

    @property
    def window(self) -> int:
        """How many bags are handed out at a time; those of a cluster are not known beforehand."""
        return AHEAD * max(1, MAX_WORKERS // 4 if self.scheduler else self.count)


class _Here(Executor):
    """This process: a task is done when it is submitted."""

    def submit(self, task: Callable[..., Any], /, *args: Any, **options: Any) -> "Future[Any]":
        done: Future[Any] = Future()
        try:
            done.set_result(task(*args, **options))
        except Exception as error:  # whoever asks for the result gets it
            done.set_exception(error)
        return done


def _end_with_parent() -> None:
    """In a worker: end when the process that started it does, however that ended."""
    parent = multiprocessing.parent_process()

    def wait() -> None:
        if parent is not None:
            parent.join()
            os._exit(1)

    threading.Thread(target=wait, daemon=True).start()


def _dask(scheduler: str) -> Executor:
    try:
        from distributed import Client
    except ImportError as error:
        raise DataError("--scheduler needs Dask: pip install 'nlsid[fleet]'") from error
    try:
        client: Any = Client(scheduler, set_as_default=False)
    except (OSError, ValueError) as error:
        raise DataError(f"no Dask scheduler answers at {scheduler}: {error}") from error
    executor: Executor = client.get_executor()
    return executor
