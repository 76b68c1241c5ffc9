"""Hostile files and numbers: refused with a reason, or decided rightly; no traceback, no hang."""

import json
import os
import shutil
import subprocess
import sys
import time
from collections.abc import Callable
from decimal import localcontext
from fractions import Fraction
from itertools import combinations
from pathlib import Path
from typing import Any

import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from nlsid_core import kernel
from nlsid_core.kernel import Rejected, text
from nlsid_core.kernel.checking import read_regular
from nlsid_core.kernel.exact import at_most, definite, semidefinite
from nlsid_core.kernel.files import (
    MAX_DEGREE,
    MAX_WHOLE,
    Node,
    bound_files,
    digest,
    parse,
    plain,
)
from nlsid_core.kernel.polynomials import Ring
from nlsid_core.kernel.positivity import read_squares
from tests.core.kernel.mutations import CORPUS
from tests.core.kernel.oracle_continuous import determinant
from tests.core.kernel.refusals import refused

SECONDS = 20.0  # of processor time that any one refusal may take, on a slow machine
json_values = st.recursive(
    st.none()
    | st.booleans()
    | st.integers()
    | st.floats()
    | st.text(max_size=5)
    | st.sampled_from([2**53, 2**53 + 1, -(2**63), 5e-324, -0.0, "1/3", "1/0", "-7", "9" * 5000]),
    lambda inner: (
        st.lists(inner, max_size=4)
        | st.dictionaries(
            st.sampled_from(["basis", "exponents", "unit", "file", "x"]), inner, max_size=4
        )
    ),
    max_leaves=12,
)


def ring(count: int = 2) -> Ring:
    return Ring(count, 64)


WITNESS = {
    "basis": Node([[0, 0], [1, 0]], "basis"),
    "columns": Node([0, 0], "columns"),
    "squares": Node({"unit": 0, "factors": [[[1]]]}, "squares"),
}
READERS: dict[str, Callable[[Node], Any]] = {
    "members": lambda node: node.members("basis columns squares?"),
    "items": lambda node: node.items(1, 3),
    "text": lambda node: node.text(),
    "number": lambda node: node.number(),
    "whole": lambda node: node.whole(0, 10),
    "rational": lambda node: node.rational(),
    "array": lambda node: node.array(None, 2),
    "wholes": lambda node: node.wholes(None, 2),
    "basis": lambda node: read_squares(WITNESS | {"basis": node}, ring()),
    "columns": lambda node: read_squares(WITNESS | {"columns": node}, ring()),
    "squares": lambda node: read_squares(WITNESS | {"squares": node}, ring()),
    "polynomial": lambda node: node.polynomial(2),
    "bindings": lambda node: bound_files(node, lambda _: b"{}", "model"),
}


@pytest.mark.parametrize("reader", READERS)
@settings(max_examples=25, deadline=None)
@given(value=json_values)
@example(value=[])
@example(value=[[]])
@example(value=[[True, 1]])
@example(value={"unit": True, "factors": [[[1]]]})
@example(value={"unit": 0, "factors": [[[1.5]]]})
@example(value={"unit": 0, "factors": [[[1, 2, 3]]]})
@example(value={"unit": 0, "factors": [[[1]]], "weights": [1], "scale": 1})
@example(value={"exponents": [[0, 0], [0, 0]], "coefficients": [1, 1]})
@example(value={"exponents": [[1, 0], [0, 0]], "coefficients": [1]})
@example(value={"model": {"file": "../x", "digest": "sha256:0"}})
@example(value={"model": {"file": "x\n", "digest": "sha256:0"}})
@example(value="1" * 5000)
@example(value="٣")  # a digit that is not ASCII
def test_a_reader_returns_or_refuses(reader: str, value: Any) -> None:
    """Whatever a file holds: `Rejected`, or what the reader promises."""
    try:
        content = json.dumps({"v": value}).encode()
    except ValueError:
        return
    try:
        node = Node(parse(content, "file").members("v")["v"].value, "v")
        found = READERS[reader](node)
    except Rejected as refusal:
        message = str(refusal)
    else:
        message = ""
    if message:
        assert message.isprintable()
        return
    if reader == "number":
        assert isinstance(found, Fraction)
        assert type(value) in (int, float)
    if reader == "whole":
        assert type(value) is int
        assert 0 <= value <= 10


@settings(max_examples=150, deadline=None)
@given(st.floats(allow_nan=False, allow_infinity=False) | st.integers(-(2**60), 2**60))
@example(-0.0)
@example(5e-324)
@example(1.7976931348623157e308)
@example(2**53)
@example(2**53 + 1)
def test_a_number_is_read_as_the_float64_it_is(value: float) -> None:
    content = json.dumps({"v": value}).encode()
    if type(value) is int and abs(value) > MAX_WHOLE:
        with refused("malformed"):
            parse(content, "file")
        return
    found = parse(content, "file").members("v")["v"].number()
    assert found == Fraction(value)
    assert float(found) == value


@settings(max_examples=150, deadline=None)
@given(st.floats(allow_nan=False, allow_infinity=False, min_value=1e-300), st.integers(0, 25))
def test_a_changed_digit_is_refused(value: float, place: int) -> None:
    """Any text that is not the decimal form of its own float64."""
    shown = repr(value)
    if "." not in shown or place >= len(shown) or not shown[place].isdigit():
        return
    for digit in "0123456789":
        changed = shown[:place] + digit + shown[place + 1 :]
        try:
            node = parse(b'{"v": %s}' % changed.encode(), "file")
        except Rejected:
            continue
        assert Fraction(*float(changed).as_integer_ratio()) == node.members("v")["v"].number()
        assert Fraction(repr(float(changed))) == Fraction(changed)


BAD_TEXTS = {
    "twice": b'{"format": "nlsid/proof", "format": "nlsid/proof"}',
    "nan": b'{"v": NaN}',
    "infinity": b'{"v": -Infinity}',
    "too large": b'{"v": 1e999}',
    "huge exponent": b'{"v": 1e-99999999999999999999}',
    "long": b'{"v": 0.' + b"1" * 100 + b"}",
    "an integer of a million digits": b'{"v": ' + b"9" * 10**6 + b"}",
    "lists": b"[" * 100_000,
    "objects": b'{"a":' * 100_000,
    "closed lists": b'{"v": ' + b"[" * 50_000 + b"]" * 50_000 + b"}",
    "bytes": b"\xff\xfe\x00",
    "empty": b"",
    "a list": b"[]",
    "null": b"null",
    "two documents": b"{}{}",
    "a surrogate": b'{"v": "\\ud800"',
}


@pytest.mark.parametrize("name", BAD_TEXTS)
def test_what_is_no_document_is_refused(name: str) -> None:
    started = time.process_time()
    with refused("malformed"):
        kernel.decide(BAD_TEXTS[name], lambda _: b"")
    assert time.process_time() - started < SECONDS


def proof(claim: Any, parts: Any) -> bytes:
    document = {"format": "nlsid/proof", "version": 2, "claim": claim, "proof": parts}
    return json.dumps(document).encode()


def test_only_regular_files_beside_the_proof_are_read(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "fifo")
    (tmp_path / "large").touch()
    os.truncate(tmp_path / "large", 100 * 2**20)
    for name in ("fifo", ".", "absent"):
        with pytest.raises(OSError, match=r"\w"):
            read_regular(tmp_path / name)
    with refused("too_large"):
        kernel.check(tmp_path / "large")
    about = {"model": {"file": "fifo", "digest": digest(b"{}")}}
    (tmp_path / "b.proof.json").write_bytes(
        proof({"kind": "stability", "about": about, "rate": 0.5}, {})
    )
    with refused("mismatch"):
        kernel.check(tmp_path / "b.proof.json")


@settings(max_examples=100, deadline=None)
@given(
    st.lists(
        st.lists(st.fractions() | st.integers(-3, 3), min_size=1, max_size=4),
        min_size=1,
        max_size=4,
    )
)
def test_definiteness_is_refused_or_true(rows: Any) -> None:
    """Every leading minor by cofactors, and vectors x with x'Mx < 0 where it is refused."""
    size = len(rows)
    if any(len(row) != size for row in rows):
        for decide in (definite, semidefinite):
            with refused("too_large"):
                decide(rows, "M")
        return
    M = [[Fraction(rows[max(i, j)][min(i, j)]) for j in range(size)] for i in range(size)]
    minors = [determinant([row[:k] for row in M[:k]]) for k in range(1, size + 1)]
    if all(minor > 0 for minor in minors):
        definite(M, "M")
        semidefinite(M, "M")
        return
    with refused("not_definite"):
        definite(M, "M")
    principal = [
        determinant([[M[i][j] for j in chosen] for i in chosen])
        for k in range(1, size + 1)
        for chosen in combinations(range(size), k)
    ]
    if all(minor >= 0 for minor in principal):
        semidefinite(M, "M")
    else:
        with refused("not_definite"):
            semidefinite(M, "M")


def test_matrices_that_floats_cannot_tell_and_matrices_that_take_too_long() -> None:
    big = 10**40
    definite([[big, big - 1], [big - 1, big - 1]], "M")
    semidefinite([[big, big], [big, big]], "M")
    with pytest.raises(Rejected):
        definite([[big, big], [big, big]], "M")
    with pytest.raises(Rejected):
        semidefinite([[big, big + 1], [big + 1, big]], "M")
    with pytest.raises(Rejected):
        semidefinite([[0, 1], [1, 10]], "M")
    with refused("not_definite"):
        definite([[1, 0], [Fraction(1, 10**90), 1]], "M")
    started = time.process_time()
    with refused("too_large"):
        definite(
            [[Fraction(int(i == j), 10**200 + i + 1) for j in range(100)] for i in range(100)], "M"
        )
    assert time.process_time() - started < SECONDS
    with refused("not_below"):
        at_most(Fraction(1, 3) + Fraction(1, 10**90), Fraction(1, 3), "no")


@settings(max_examples=150, deadline=None)
@given(st.fractions() | st.floats(allow_nan=False, allow_infinity=False), st.integers(1, 12))
@example(9.9996, 4)
@example(-9.9996, 4)
def test_a_printed_bound_is_on_its_side_and_near(value: Any, digits: int) -> None:
    value = Fraction(value)
    shown = text.below(value, digits), text.above(value, digits)
    if shown[0] == shown[1]:  # short: it stands for the float64 that it is nearest to
        assert value in (Fraction(shown[0]), Fraction(float(shown[0])))
        return
    low, high = map(Fraction, shown)
    assert low < value < high
    assert high - low <= abs(value) * Fraction(10) ** (1 - digits)


def test_numbers_of_thousands_of_digits_are_printed() -> None:
    assert text.below(Fraction(10**5000, 7)) == "1.428e+4999"
    assert text.above(Fraction(-7, 10**5000)) == "-7e-5000"


def test_the_rounding_of_whoever_calls_changes_no_bound() -> None:
    """Two digits were kept of 1235, to nearest: 1200 was said to be above 1234.5678."""
    with localcontext(prec=2):
        assert text.above(Fraction(12345678, 10000)) == "1235"
        assert text.below(Fraction(0.125)) == "0.125"


@settings(max_examples=100, deadline=None)
@given(st.fractions(min_value=0) | st.floats(0, allow_infinity=False, allow_nan=False))
def test_a_root_is_above_and_near(value: Any) -> None:
    value = Fraction(value)
    root = text.root_above(value)
    assert root * root >= value
    assert root * root <= value * (1 + Fraction(1, 2**60))


@settings(max_examples=100, deadline=None)
@given(st.fractions() | st.floats(allow_nan=False, allow_infinity=False))
def test_an_exact_number_is_printed_exactly(value: Any) -> None:
    """As p/q, or in the shortest form that is this float64."""
    shown = text.exact(Fraction(value))
    assert Fraction(shown) == value or Fraction(float(shown)) == value


@settings(max_examples=100, deadline=None)
@given(st.text())
def test_a_message_stays_on_one_line(words: str) -> None:
    assert plain(words).isprintable()


def test_monomials_whose_exponents_would_run_into_each_other_are_refused() -> None:
    assert ring().key([MAX_DEGREE, 0]) != ring().key([0, 1])
    for exponents in ([40, 40], [2**40, 0], [1], [1, 2, 3]):
        with refused("malformed"):
            Node([exponents], "monomials").monomials(2)
    for exponents in ([64, 0], [2**52, 0], [-1, 2]):
        node = Node({"exponents": [exponents], "coefficients": [1]}, "p")
        with refused("malformed"):
            node.polynomial(2)
    wide = Ring(2, 64)
    p = wide.variables[0]
    for _ in range(5):
        p = p * p
    with refused("too_large"):
        p * p


def test_the_kernel_imports_the_standard_library_only_and_runs_alone(tmp_path: Path) -> None:
    folder = Path(kernel.__file__).parent
    shutil.copytree(CORPUS / "stability" / "linear", tmp_path, dirs_exist_ok=True)
    path = tmp_path / "claim.proof.json"
    forged = json.loads(path.read_text())
    forged["claim"]["rate"] = 0.6
    (tmp_path / "false.proof.json").write_text(json.dumps(forged))
    program = (
        "import runpy, sys\n"
        f"sys.argv = ['kernel', {str(path)!r}]\n"
        "try:\n"
        f"    runpy.run_path({str(folder)!r}, run_name='__main__')\n"
        "finally:\n"
        "    print(sorted({name.split('.')[0] for name in sys.modules}))\n"
    )
    ran = subprocess.run(
        [sys.executable, "-I", "-S", "-c", program], capture_output=True, text=True, check=False
    )
    assert ran.returncode == 0, ran.stderr
    loaded = {name for name in eval(ran.stdout.splitlines()[-1]) if not name.startswith("_")}
    assert loaded - set(sys.stdlib_module_names) <= {"kernel"}
    alone = [sys.executable, "-I", str(folder)]
    for name, status, word in (
        ("claim", 0, "PROVED"),
        ("false", 1, "not_definite"),
        ("no", 2, "read"),
    ):
        file = str(tmp_path / f"{name}.proof.json")
        ran = subprocess.run([*alone, file], capture_output=True, text=True, check=False)
        assert (ran.returncode, word in ran.stdout) == (status, True)
