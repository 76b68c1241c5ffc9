"""Documents on disk: strict JSON whose numbers round-trip exactly, content digests, safe writing.

A float64 printed by Python's `repr` reads back as the same float64, so a document holds exact
numbers; one whose digits are not a float64's is refused, so no changed digit goes unnoticed. A
digest is the SHA-256 of a file's bytes; `encode` gives the bytes that `write_document` writes.
"""

import hashlib
import json
import math
import os
import tempfile
from collections.abc import Iterable
from decimal import Decimal
from pathlib import Path
from typing import Any, NoReturn, TypeVar

import numpy as np

from nlsid_core.arrays import FloatArray, Json
from nlsid_core.errors import DocumentError

T = TypeVar("T")
VERSION = 2  # of every document
MAX_BYTES = 64 * 2**20  # a proof of hundreds of Gram matrices is a few MB; more is not ours
_SCALARS = json.JSONEncoder(allow_nan=False)


def load_document(path: Path | str) -> Json:
    """Read a JSON object from `path`.

    Raises DocumentError for anything but one finite, duplicate-free, reasonably nested JSON object;
    OS errors pass through.
    """
    path = Path(path)
    size = path.stat().st_size
    if size > MAX_BYTES:
        raise DocumentError(f"{path}: {size} bytes; a document has at most {MAX_BYTES}")
    return parse_document(path.read_bytes(), source=str(path))


def parse_document(text: bytes | str, *, source: str = "document") -> Json:
    """Parse one JSON object; see `load_document` for what is refused."""
    raw = text.encode("utf-8", "surrogatepass") if isinstance(text, str) else text
    if len(raw) > MAX_BYTES:
        raise DocumentError(f"{source}: {len(raw)} bytes; a document has at most {MAX_BYTES}")
    try:
        parsed = json.loads(
            raw.decode("utf-8"),
            object_pairs_hook=_unique_object,
            parse_constant=_refuse_constant,
            parse_float=_finite_float,
            parse_int=_bounded_int,
        )
    except (ValueError, RecursionError) as error:
        raise DocumentError(f"{source}: not a valid document: {error}") from error
    if not isinstance(parsed, dict):
        raise DocumentError(f"{source}: expected a JSON object, found {type(parsed).__name__}")
    return parsed


def encode(document: Json) -> bytes:
    """The bytes of a document's file: indented JSON, shortest exact floats."""
    return _written(document).encode("ascii") + b"\n"


def canonical(content: Json) -> bytes:
    """Sorted keys and no white space: for comparing contents, not files."""
    text = json.dumps(content, sort_keys=True, separators=(",", ":"), allow_nan=False)
    return text.encode("ascii")


def digest(document: Json | bytes) -> str:
    """`sha256:<hex>` of a file's bytes, or of those that `write_document` would write."""
    content = document if isinstance(document, bytes) else encode(document)
    return "sha256:" + hashlib.sha256(content).hexdigest()


def write_document(path: Path | str, document: Json) -> None:
    """Write `document` as indented JSON; the file appears whole or not at all."""
    write_atomically(path, encode(document))


def write_atomically(path: Path | str, content: bytes) -> None:
    """Write to a temporary name beside `path` and rename, so that readers never see a part."""
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    handle, temporary = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}.")
    try:
        with os.fdopen(handle, "wb") as stream:
            stream.write(content)
            stream.flush()
            os.fsync(stream.fileno())
        os.chmod(temporary, 0o644)
        os.replace(temporary, path)
    except BaseException:
        Path(temporary).unlink(missing_ok=True)
        raise


def member(document: Json, key: str, kind: type | tuple[type, ...], *, source: str) -> Any:
    """`document[key]`, checked to be of `kind`; DocumentError names what is missing or wrong."""
    if not isinstance(document, dict):
        raise DocumentError(f"{source}: should be an object, is {type(document).__name__}")
    if key not in document:
        raise DocumentError(f"{source}: '{key}' is missing; it has: {', '.join(document)}")
    value = document[key]
    kinds = kind if isinstance(kind, tuple) else (kind,)
    if (isinstance(value, bool) and bool not in kinds) or not isinstance(value, kinds):
        names = " or ".join(k.__name__ for k in kinds)
        raise DocumentError(f"{source}: '{key}' should be {names}, is {type(value).__name__}")
    return value


def number(document: Json, key: str, *, source: str) -> float:
    """`document[key]` as a finite float."""
    return float(member(document, key, (float, int), source=source))


def array(document: Json, key: str, shape: tuple[int | None, ...], *, source: str) -> FloatArray:
    """`document[key]` as a read-only float array of `shape` (None: any length on that axis)."""
    nested = member(document, key, list, source=source)
    if not all(_is_number(entry) for entry in _leaves(nested)):
        raise DocumentError(f"{source}: '{key}' should hold numbers only")
    try:
        values = np.array(nested, dtype=np.float64)
    except ValueError as error:
        raise DocumentError(f"{source}: '{key}' is ragged") from error
    if 0 in shape and values.size == 0:
        values = values.reshape([0 if s is None else s for s in shape])
    wanted = "x".join("any" if s is None else str(s) for s in shape)
    fits = values.ndim == len(shape) and all(
        s is None or s == given for s, given in zip(shape, values.shape, strict=True)
    )
    if not fits:
        given = "x".join(map(str, values.shape))
        raise DocumentError(f"{source}: '{key}' should have shape {wanted}, has {given}")
    values.setflags(write=False)
    return values


def named_digests(entries: list[Any], *, source: str) -> list[tuple[str, str]]:
    """A list of {"name", "digest"} objects as pairs."""
    pairs = []
    for entry in entries:
        if not isinstance(entry, dict):
            raise DocumentError(f"{source}: expected objects with a name and a digest")
        name, stated = (member(entry, key, str, source=source) for key in ("name", "digest"))
        pairs.append((name, stated))
    return pairs


def header(document: Json, name: str, *, source: str, kind: str | None = None) -> None:
    """Check `format`, `version` and `kind`, if one is wanted; DocumentError says what was found."""
    found = member(document, "format", str, source=source)
    if found != name:
        raise DocumentError(f"{source}: format is '{found}', expected '{name}'")
    given = member(document, "version", int, source=source)
    if given != VERSION:
        raise DocumentError(
            f"{source}: version {given}; this nlsid reads version {VERSION}. Make it again with "
            "the command that wrote it"
        )
    if kind is not None and document.get("kind") != kind:
        raise DocumentError(f"{source}: kind is {document.get('kind')!r}, expected '{kind}'")


def _leaves(nested: list[Any]) -> Iterable[Any]:
    for entry in nested:
        if isinstance(entry, list):
            yield from _leaves(entry)
        else:
            yield entry


def _is_number(value: Any) -> bool:
    return isinstance(value, (int, float)) and not isinstance(value, bool)


def _unique_object(pairs: list[tuple[str, Any]]) -> Json:
    result = dict(pairs)
    if len(result) != len(pairs):
        seen: set[str] = set()
        twice = next(key for key, _ in pairs if key in seen or seen.add(key))  # type: ignore[func-returns-value]
        raise ValueError(f"key '{twice}' occurs twice")
    return result


def _refuse_constant(name: str) -> NoReturn:
    raise ValueError(f"{name} is not a number a document may hold")


def _finite_float(text: str) -> float:
    value = float(text)
    if not math.isfinite(value):
        raise ValueError(f"{text} does not fit a float64")
    if repr(value) != text and Decimal(repr(value)) != Decimal(text):
        raise ValueError(f"{text} is not a float64; the nearest one is {value!r}")
    return value


def _bounded_int(text: str) -> int:
    value = int(text) if len(text) < 32 else 2**63
    if abs(value) >= 2**63:
        raise ValueError(f"integer {text[:24]}... does not fit 64 bits")
    return value


def _written(value: Any, margin: str = "") -> str:
    """Indented by a space for each level, but an array of scalars is one line: a matrix's row."""
    arrays, inner = (dict, list, tuple), f"\n{margin} "
    if isinstance(value, dict) and value:
        rows = [
            f"{_SCALARS.encode(key)}: {_written(part, inner[1:])}" for key, part in value.items()
        ]
        return f"{{{inner}{f',{inner}'.join(rows)}\n{margin}}}"
    if isinstance(value, list | tuple) and any(isinstance(part, arrays) for part in value):
        rows = [_written(part, inner[1:]) for part in value]
        return f"[{inner}{f',{inner}'.join(rows)}\n{margin}]"
    return _SCALARS.encode(value)
