"""What a run has read so far, in one SQLite file: a killed run goes on, a second reads what is new.

A row is one bag's result, under a key made of what was asked and of what storage says of the bag.
A row is there whole or not at all; nothing in it is ever executed.
"""

import hashlib
import json
import sqlite3
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import TracebackType
from typing import Any, Final

from bags.recordings.remote import RemotePath
from nlsid_core.errors import DataError

BUSY: Final = 60.0  # s that another run may hold the file


class Manifest:
    """Results by key; with `path` None in a file that is gone afterwards. A context manager.

    Several runs may share a file. Raises DataError if it is something else, is damaged, or cannot
    be written.
    """

    def __init__(self, path: Path | None) -> None:
        self._path = path
        if path is not None:
            path.parent.mkdir(parents=True, exist_ok=True)
        with self._named():
            self._rows = sqlite3.connect(
                "" if path is None else path, isolation_level=None, timeout=BUSY
            )
            self._rows.execute("pragma journal_mode = wal")
            self._rows.execute("pragma synchronous = normal")
            self._rows.execute(
                "create table if not exists bags (key text primary key, bag text, content blob)"
            )

    def __contains__(self, key: str) -> bool:
        with self._named():
            found = self._rows.execute("select 1 from bags where key = ?", (key,)).fetchone()
        return found is not None

    def find(self, key: str) -> bytes:
        """The result under a key that is there."""
        with self._named():
            row = self._rows.execute("select content from bags where key = ?", (key,)).fetchone()
        if row is None or not isinstance(row[0], bytes):
            raise DataError(f"{self._path}: a row of this manifest of bags is damaged; remove it")
        return row[0]

    def keep(self, key: str, bag: str, content: bytes) -> None:
        """Write a result; it replaces one under the same key."""
        with self._named():
            self._rows.execute("insert or replace into bags values (?, ?, ?)", (key, bag, content))

    @contextmanager
    def _named(self) -> Iterator[None]:
        """Errors of SQLite as DataErrors that say what to do."""
        try:
            yield
        except sqlite3.OperationalError as error:  # locked, full, not to be written
            raise DataError(f"the manifest {self._path} cannot be used: {error}") from error
        except sqlite3.DatabaseError as error:
            raise DataError(f"{self._path}: not a manifest of bags ({error}); remove it") from error

    def __enter__(self) -> "Manifest":
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        at: TracebackType | None,
    ) -> None:
        self._rows.close()


def key_of(bag: Path, name: str, asked: str) -> str:
    """The key of a question about a bag: it changes when its files do. OSError if it is gone."""
    files = sorted(bag.iterdir()) if bag.is_dir() else [bag]
    states: list[Any] = [(file.name, *_state(file)) for file in files]
    return hashlib.sha256(json.dumps([asked, name, str(bag), states]).encode()).hexdigest()


def _state(file: Path) -> tuple[int, str]:
    if isinstance(file, RemotePath):
        return file.entry.size, file.entry.tag
    found = file.stat()
    return found.st_size, str(found.st_mtime_ns)
