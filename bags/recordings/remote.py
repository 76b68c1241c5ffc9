"""Bags in object storage or on a web server, as paths: `s3://bucket/drive.mcap`, `https://...`.

A RemotePath is a Path for whoever names, lists and opens bags. What is opened delivers the bytes
that are asked for and no others: ranges that lie close together are one request, several requests
run beside each other. obstore knows the protocols, and repeats a request that fails for a stated
time; credentials are those of the environment or of a profile, and are never part of a name.
"""

import os
import re
import stat
from bisect import bisect_left, bisect_right
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass
from datetime import timedelta
from fnmatch import fnmatchcase
from functools import cache, cached_property
from pathlib import Path, PosixPath
from typing import Any, Final, TypeVar

from nlsid_core.errors import BagError

GAP_BYTES: Final = 16 * 2**10  # ranges closer than this are one request, whose price they share
HELD_BYTES: Final = 64 * 2**20  # of a file that stay in memory for who opens it again
TAIL_BYTES: Final = 16 * 2**10  # the first request: footer, most summaries and the last index
MARK_BYTES: Final = 8 * 2**10  # at the end, of which digests are made (docs/decisions/0027)
TOGETHER: Final = 16  # requests that run beside each other, and fail or succeed together
PATIENCE: Final = 60.0  # s that a request may fail
MOST_REPEATED: Final = 10_000  # the patience ends before
WAITS: Final = {  # before a request is repeated: the first, and the longest
    "init_backoff": timedelta(seconds=0.2),
    "max_backoff": timedelta(seconds=10),
    "base": 2,
}
WEB: Final = ("http:", "https:")  # where nothing can be listed
SHORTEST_SECRET: Final = 6  # letters

_URL: Final = re.compile(r"([A-Za-z][A-Za-z0-9+.-]*):/{1,2}(?=[^/])")
_SECRET: Final = re.compile(
    r"(?<=//)[^/\s'\"]*@|(?<=[?])[^\s'\"<>]+"
)  # of a URL in an error's text
_WILD: Final = re.compile(r"[*?\[]")

T = TypeVar("T")


class StorageError(BagError):
    """Storage did not deliver: of the bag itself nothing is known."""


@dataclass(frozen=True, slots=True)
class Entry:
    """What storage says of a name: bytes, whether it is a folder, and what changes with content.

    tag: the ETag, or the time of the last change; empty if storage says neither.
    """

    size: int
    folder: bool
    tag: str


class Parts:
    """Parts of a file, of which the oldest leave when there are more than HELD_BYTES."""

    def __init__(self) -> None:
        self._content: dict[int, bytes] = {}  # by their first bytes, the oldest first
        self._starts: list[int] = []

    def find(self, start: int, end: int) -> bytes | None:
        """These bytes, if they are in one part."""
        at = bisect_right(self._starts, start) - 1
        if at < 0:
            return None
        first = self._starts[at]
        found = self._content[first][start - first : end - first]
        return found if len(found) == end - start else None

    def hold(self, start: int, content: bytes) -> None:
        """Keep a part, in the place of those that begin in it."""
        inside = slice(*(bisect_left(self._starts, at) for at in (start, start + len(content))))
        for begun in self._starts[inside]:
            del self._content[begun]
        self._starts[inside] = [start]
        self._content[start] = content
        while len(self._starts) > 1 and sum(map(len, self._content.values())) > HELD_BYTES:
            oldest = next(iter(self._content))
            del self._content[oldest]
            self._starts.remove(oldest)


class RemotePath(PosixPath):
    """A file or a folder in storage; the parts of its URL are the parts of the path.

    patience: s for which a failing request is repeated. Instances keep what they fetched, at most
    HELD_BYTES a file; `requests` and `fetched` (bytes) count what was asked of storage, but for
    listings. A copy in another process knows the entry, and has fetched nothing.
    """

    patience: float = PATIENCE
    requests: int = 0
    fetched: int = 0
    _entry: Entry | None = None

    def __str__(self) -> str:
        protocol, *rest = self.parts
        return f"{protocol}//{'/'.join(rest)}"

    def __reduce__(self) -> tuple[Any, ...]:
        return _rebuilt, (str(self), self.patience, self._entry)

    def __truediv__(self, name: Any) -> "RemotePath":
        if str(name) not in self._below:
            child = self._below[str(name)] = super().__truediv__(name)
            child.patience = self.patience
        return self._below[str(name)]

    @cached_property
    def _below(self) -> dict[str, "RemotePath"]:
        """The paths below it that were asked for."""
        return {}

    @cached_property
    def _held(self) -> Parts:
        return Parts()

    def forget(self) -> None:
        """Drop all that was fetched, here and below."""
        self.__dict__.pop("_held", None)
        for child in self._below.values():
            child.forget()

    @property
    def entry(self) -> Entry:
        """What storage says of it. FileNotFoundError if it is gone, BagError without an answer."""
        if self._entry is None:
            self._entry = self._asked(self._described)
        return self._entry

    def _described(self) -> Entry:
        self.requests += 1
        with suppress(FileNotFoundError):  # it may be a folder
            if self._key:
                return _entry(obstore().head(self._store, self._key))
        if not next(self._listed(), None):
            raise FileNotFoundError(f"{self} is not there")
        return Entry(0, True, "")

    def _listed(self) -> Iterator[tuple[str, Entry]]:
        """What lies in the folder, by its key."""
        if self.parts[0] in WEB:
            return
        folder = f"{self._key}/" if self._key else None
        found = obstore().list_with_delimiter(self._store, folder)
        yield from ((key, Entry(0, True, "")) for key in found["common_prefixes"])
        yield from ((described["path"], _entry(described)) for described in found["objects"])

    @property
    def _key(self) -> str:
        """What storage calls it, in its bucket or on its server."""
        return "/".join(self.parts[2:])

    @property
    def _store(self) -> Any:
        root = f"{self.parts[0]}//{self.parts[1]}"
        return _opened(root, self.patience, os.environ.get("AWS_ENDPOINT_URL", ""))

    def anew(self) -> "RemotePath":
        """The same place, of which nothing is known yet."""
        return _rebuilt(str(self), self.patience, None)

    def exists(self, *, follow_symlinks: bool = True) -> bool:  # noqa: ARG002 - as Path has it
        """Whether storage has it."""
        try:
            return self.entry is not None
        except FileNotFoundError:
            return False

    def is_file(self, *, follow_symlinks: bool = True) -> bool:  # noqa: ARG002
        """Whether it is there and no folder."""
        return self.exists() and not self.entry.folder

    def is_dir(self, *, follow_symlinks: bool = True) -> bool:  # noqa: ARG002
        """Whether names begin with it."""
        return self.exists() and self.entry.folder

    def stat(self, *, follow_symlinks: bool = True) -> os.stat_result:  # noqa: ARG002
        """Its kind and its size; nothing else is known."""
        kind = stat.S_IFDIR if self.entry.folder else stat.S_IFREG
        return os.stat_result((kind, 0, 0, 0, 0, 0, self.entry.size, 0, 0, 0))

    def resolve(self, strict: bool = False) -> "RemotePath":  # noqa: ARG002 - as Path has it
        """Itself: storage has no links."""
        return self

    def iterdir(self) -> Iterator["RemotePath"]:  # type: ignore[override]
        """What is in the folder."""
        for key, entry in self._asked(lambda: list(self._listed())):
            child = self / key.rpartition("/")[2]
            child._entry = entry
            yield child

    def read_bytes(self) -> bytes:
        """All of it."""
        return self.read_range(0, self.entry.size)

    def read_range(self, start: int, end: int) -> bytes:
        """The bytes from `start` to `end`, fetched unless they are held."""
        if end <= start:
            return b""
        self.fetch([(start, end)])
        found = self._held.find(start, end)
        assert found is not None
        return found

    def fetch(self, ranges: Iterable[tuple[int, int]]) -> None:
        """Hold these (start, end) from now on, with as few requests as GAP_BYTES makes of them.

        Raises FileNotFoundError if the file is gone, BagError if storage does not deliver.
        """
        merged: list[list[int]] = []
        for start, end in sorted(r for r in ranges if self._held.find(*r) is None):
            if merged and start <= merged[-1][1] + GAP_BYTES:
                merged[-1][1] = max(merged[-1][1], end)
            else:
                merged.append([start, end])
        if merged and merged[-1][1] > self.entry.size:
            raise BagError(f"{self} has {self.entry.size} bytes and says to read {merged[-1][1]}")
        for first in range(0, len(merged), TOGETHER):
            starts, ends = zip(*merged[first : first + TOGETHER], strict=True)
            self.requests += len(starts)
            for start, end, part in zip(starts, ends, self._ranges(starts, ends), strict=True):
                if len(part) != end - start:
                    raise StorageError(
                        f"{self}: storage did not deliver: {len(part)} bytes came of the "
                        f"{end - start} from {start} on"
                    )
                self.fetched += len(part)
                self._held.hold(start, bytes(part))

    def _ranges(self, starts: Iterable[int], ends: Iterable[int]) -> Any:
        return self._asked(
            lambda: obstore().get_ranges(
                self._store, self._key, starts=starts, ends=ends, coalesce=0
            )
        )

    def identity(self) -> bytes:
        """What tells the file from others without reading it: its entry, its last bytes and, but
        for S3, whose tags are of the content, its URL: other tags tell versions of one URL apart.
        """
        import hashlib  # a slow part of the standard library, for what is fetched only

        size = self.entry.size
        tail = self.read_range(max(0, size - MARK_BYTES), size)
        url = "" if str(self).startswith("s3://") else f" {self}"
        return f"{size} {self.entry.tag} {hashlib.sha256(tail).hexdigest()}{url}\n".encode()

    def _asked(self, ask: Callable[[], T]) -> T:
        """The answer of storage; obstore raises errors of its own."""
        try:
            return ask()
        except FileNotFoundError as error:
            raise FileNotFoundError(f"{self} is not there") from error
        except BagError:
            raise
        except Exception as error:
            raise StorageError(f"{self}: storage did not deliver: {_short(error)}") from error


def place(given: Path | str, *, patience: float | None = None) -> Path:
    """The path that is meant: a RemotePath for a URL, of this machine otherwise.

    patience: s for which a failing request is repeated (None: PATIENCE, or as it is). A Path that
    was made of a URL, `s3:/bucket/...`, is taken for it. Raises BagError for a URL that carries a
    password, a token or a query: names of bags are written into files.
    """
    text = str(given).lstrip()
    if not isinstance(given, RemotePath):
        found = _URL.match(text)
        if found is None:
            return Path(given)
        protocol, rest = found.group(1).lower(), text[found.end() :]
        if cut := re.search("[?#]" if protocol in ("http", "https") else "[?][^/]*=", rest):
            raise BagError(
                f"{protocol}://{rest[: cut.start()].rpartition('@')[2]}: a query may hold a "
                "secret, and names are written into files; give a URL without it, and credentials "
                "in the environment"
            )
        if "@" in rest.partition("/")[0]:
            raise BagError(
                f"a password does not belong into a URL ({protocol}://...@...); give credentials "
                "in the environment"
            )
        given = RemotePath(f"{protocol}:/{rest}")
    if patience is not None:
        given.patience = patience
    return given


def is_url(given: Path | str) -> bool:
    """Whether `place` takes it for something that is not on this machine."""
    return isinstance(place(given), RemotePath)


def matching(path: Path) -> list[Path]:
    """The files and folders that a pattern with `*`, `?` or `[...]` means, by name.

    A path without a pattern, or of a file with such a name on this machine, means itself.
    """
    if not _WILD.search(str(path)) or (not isinstance(path, RemotePath) and path.exists()):
        return [path]
    if not isinstance(path, RemotePath):
        start = Path(path.anchor)
        return sorted(start.glob(str(path.relative_to(start))))
    if path.parts[0] in WEB:
        raise BagError(f"{path}: a web server does not list its files; name each of them")
    places = [_rebuilt(f"{path.parts[0]}//{path.parts[1]}", path.patience, None)]
    for part in path.parts[2:]:
        if _WILD.search(part):
            places = [p for place in places for p in place.iterdir() if fnmatchcase(p.name, part)]
        else:
            places = [place / part for place in places]
    return sorted(place for place in places if place.exists())


def _rebuilt(text: str, patience: float, entry: Entry | None) -> RemotePath:
    path = place(text, patience=patience)
    assert isinstance(path, RemotePath)
    path._entry = entry
    return path


def obstore() -> Any:
    """The library that reads object storage; BagError where it is not installed."""
    try:
        import obstore as library
        import obstore.store
    except ImportError as error:
        raise BagError(
            f"{error}; bags in object storage need `pip install 'nlsid[fleet]'`"
        ) from error
    return library


@cache
def _opened(root: str, patience: float, endpoint: str) -> Any:  # noqa: ARG001 - other stores
    """The bucket or server, with credentials of the environment or, of S3, else of a profile."""
    options: dict[str, Any] = {}
    if root.startswith("s3:") and "AWS_ACCESS_KEY_ID" not in os.environ:
        with suppress(ImportError, ValueError):  # without a profile: those of the machine
            from obstore.auth.boto3 import Boto3CredentialProvider

            options["credential_provider"] = Boto3CredentialProvider()
    return obstore().store.from_url(
        root,
        client_options={"allow_http": True, "timeout": f"{patience:g}s"},
        retry_config={
            "max_retries": MOST_REPEATED,
            "retry_timeout": timedelta(seconds=patience),
            "backoff": WAITS,
        },
        **options,
    )


def _entry(described: Mapping[str, Any]) -> Entry:
    """What storage says of an object."""
    tag = described["e_tag"] or str(described["last_modified"])
    return Entry(int(described["size"]), False, tag.strip('"'))


def _short(error: BaseException) -> str:
    """The first line of an error, without secrets that a redirection or a server told."""
    line = str(error).partition("\n")[0][:400]
    for name, value in os.environ.items():
        if len(value) >= SHORTEST_SECRET and re.search("KEY|SECRET|TOKEN|PASSWORD", name):
            line = line.replace(value, "...")
    return f"{type(error).__name__}: {_SECRET.sub('...', line)}".removesuffix(": ")
