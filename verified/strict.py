"""Hold the files of a tube or of stability to docs/certificate*.md, by members.

What the theorems do not speak of is decided here, and nothing else: which members there are, their
types, sizes and limits, names, what follows commands, the numbers of a plan.
Written from the pages, not from the first kernel. Raises Refused. Standard library only.
"""

import math
import re
from collections.abc import Iterable
from dataclasses import dataclass, replace
from fractions import Fraction
from itertools import pairwise
from typing import Any

DIGEST = re.compile(r"sha256:[0-9a-f]{64}\Z")
DEGREES = 63
PHASES = 8
TEXT, STATES, SIGNALS, POWER, SPLITS = 200, 120, 50, 20, 40
IMPLICIT_STATES, IMPLICIT_INPUTS = 30, 60
MONOMIALS, TUBES, TERMS, FACTORS = 20_000, 8, 200, 4
COUNT, PLAN, MOST = 10**9, 10**6, 2**53
BYTES, TOGETHER = 32 * 2**20, 48 * 2**20  # of a file, of all of a claim
SIGNAL = "name unit path"
EQUATION = "0 = h(v, x, w), x+ = [v; shift(x, w)]"


class Refused(Exception):  # noqa: N818 - says what the pages do not allow
    """What in the files is not as the pages say."""


@dataclass(frozen=True)
class Sizes:
    """n states, m unknowns, p outputs, recorded inputs, and entries of a box that may be split."""

    n: int
    m: int
    p: int
    inputs: int
    box: int


def need(holds: bool, said: str) -> None:
    if not holds:
        raise Refused(said)


def members(value: Any, where: str, required: str, optional: str = "") -> Any:
    """An object of these members, and of no others."""
    need(type(value) is dict, f"{where} should be an object")
    missing = set(required.split()) - set(value)
    unknown = set(value) - set(required.split()) - set(optional.split())
    need(not missing, f"{where} has no {', '.join(sorted(missing))}")
    need(not unknown, f"{where} has unknown members: {', '.join(sorted(map(repr, unknown)))}")
    return value


def listed(value: Any, where: str, least: int, most: int) -> list[Any]:
    need(type(value) is list, f"{where} should be a list")
    need(least <= len(value) <= most, f"{where} should have {least} to {most} entries")
    return list(value)


def text(value: Any, where: str) -> str:
    """Printable, of one line."""
    need(type(value) is str, f"{where} should be a text")
    need(len(value) <= TEXT and value.isprintable(), f"{where} is no short printable text")
    return str(value)


def real(value: Any, where: str) -> Fraction:
    need(type(value) in (int, float) and math.isfinite(value), f"{where} should be a number")
    need(type(value) is float or abs(value) <= MOST, f"{where} is a whole number beyond 2^53")
    return Fraction(value)


def reals(value: Any, where: str, least: int, most: int | None = None) -> list[Fraction]:
    entries = listed(value, where, least, least if most is None else most)
    return [real(entry, where) for entry in entries]


def matrix(value: Any, where: str, rows: int, columns: int) -> list[list[Fraction]]:
    return [reals(row, where, columns) for row in listed(value, where, rows, rows)]


def whole(value: Any, where: str, least: int, most: int) -> int:
    need(type(value) is int and least <= value <= most, f"{where}: {least} to {most} is allowed")
    return int(value)


def increasing(values: list[Any], where: str) -> None:
    need(all(a < b for a, b in pairwise(values)), f"{where} should increase")


def word(value: Any, where: str, allowed: Iterable[str]) -> str:
    need(type(value) is str and value in allowed, f"{where} should be one of {' '.join(allowed)}")
    return str(value)


def digest(value: Any, where: str) -> None:
    need(type(value) is str and DIGEST.match(value) is not None, f"{where} should be a digest")


def head(document: Any, where: str, kinds: Iterable[str]) -> None:
    word(document.get("format"), f"{where}'s format", [f"nlsid/{where}"])
    whole(document.get("version"), f"{where}'s version", 2, 2)
    word(document.get("kind"), f"{where}'s kind", kinds)


def signals(value: Any, where: str, least: int = 1, most: int = SIGNALS) -> list[str]:
    """Of distinct names."""
    rows = listed(value, where, least, most)
    for row in rows:
        members(row, where, SIGNAL)
        for key in SIGNAL.split():
            text(row[key], f"{where}.{key}")
    names = [row["name"] for row in rows]
    need(len(set(names)) == len(names), f"{where}: two signals of one name")
    return names


def window(value: Any, inputs: int, delay: int = MOST) -> int:
    """Its entries (input, delay)."""
    rows = listed(value, "window", 0, MONOMIALS)
    for row in rows:
        i, d = listed(row, "window", 2, 2)
        whole(i, "an input of the window", 0, inputs - 1)
        whole(d, "a delay of the window", 0, delay)
    return len(rows)


def polynomials(
    value: Any, where: str, variables: int, shape: tuple[int, ...], power: int = DEGREES
) -> None:
    """One list of distinct monomials, with numbers of this shape for each."""
    members(value, where, "exponents coefficients")
    exponents = listed(value["exponents"], where, 0, MONOMIALS)
    for row in exponents:
        listed(row, f"{where}.exponents", variables, variables)
        for entry in row:
            whole(entry, f"{where}.exponents", 0, power)
        need(sum(row) <= DEGREES, f"{where}: a degree above {DEGREES}")
    need(len({tuple(row) for row in exponents}) == len(exponents), f"{where}: a monomial twice")
    for entry in listed(value["coefficients"], where, len(exponents), len(exponents)):
        if len(shape) == 1:
            reals(entry, where, *shape)
        else:
            matrix(entry, where, *shape)


def model(document: dict[str, Any]) -> Sizes:
    """A model of a kind that the theorems speak of."""
    kinds = {
        "difference_equation": _difference,
        "state_affine": _affine,
        "monotone_equation": _monotone,
        "cell_network": _cells,
        "implicit": _implicit,
        "block_cascade": _cascade,
    }
    head(document, "model", kinds)
    need(real(document.get("period"), "period") > 0, "the period should be > 0")
    return kinds[document["kind"]](document)


RECORDED = "format version kind period y u training bags"


def _recorded(model: dict[str, Any], more: str, optional: str = "") -> None:
    members(model, "model", f"{RECORDED} {more}", optional)
    text(model.get("equation", ""), "equation")


def _difference(model: dict[str, Any]) -> Sizes:
    _recorded(model, "a b c u_range", "equation")
    for key in ("y", "u"):
        signals([model[key]], key)
    n = len(reals(model["a"], "a", 1, STATES))
    reals(model["b"], "b", n + 1)
    real(model["c"], "c")
    low, high = reals(model["u_range"], "u_range", 2)
    need(low <= high, "u_range: low > high")
    return Sizes(n, 0, 1, 1, 0)


def _affine(model: dict[str, Any]) -> Sizes:
    more = "window G p y_offset y_scale u_offset u_scale u_range on_out_of_range"
    _recorded(model, more, "equation")
    p, inputs = len(signals(model["y"], "y")), len(signals(model["u"], "u"))
    lags = len(listed(model["G"], "G", 2, STATES + 1)) - 1
    box = window(model["window"], inputs, lags)
    need(lags * p <= STATES, f"more than {STATES} states")
    for G in model["G"]:
        polynomials(G, "G", box, (p, p), POWER)
    need(sum(len(G["exponents"]) for G in model["G"]) <= MONOMIALS, "G: too many monomials")
    polynomials(model["p"], "p", box, (p,), POWER)
    need(bool(model["p"]["exponents"]), "p has no monomials")
    for name, count in (("y_offset", p), ("y_scale", p), ("u_offset", inputs), ("u_scale", inputs)):
        entries = reals(model[name], name, count)
        need("scale" not in name or min(entries) > 0, f"{name} should be > 0")
    for low, high in matrix(model["u_range"], "u_range", inputs, 2):
        need(low < high, "u_range: low >= high")
    word(model["on_out_of_range"], "on_out_of_range", ("clip", "refuse"))
    return Sizes(lags * p, p, p, inputs, box)


def _monotone(model: dict[str, Any]) -> Sizes:
    _recorded(model, "e a b c window y_offset u_offset", "equation")
    signals([model["y"]], "y")
    inputs = len(signals(model["u"], "u", 0))
    _, e2, e3 = reals(model["e"], "e", 3)
    need(e3 > 0 or e2 == e3 == 0, "e is not increasing")
    n = len(reals(model["a"], "a", 1, STATES))
    reals(model["b"], "b", window(model["window"], inputs))
    reals(model["u_offset"], "u_offset", inputs)
    for key in ("c", "y_offset"):
        real(model[key], key)
    return Sizes(n, 1, 1, inputs, 0)


def _cells(model: dict[str, Any]) -> Sizes:
    _recorded(model, "maps into next output start start_samples", "equation")
    p, inputs = len(signals(model["y"], "y")), len(signals(model["u"], "u", 0))
    maps = listed(model["maps"], "maps", 1, PHASES)
    for f in maps:
        members(f, "a map", "knots values")
        knots = reals(f["knots"], "knots", 2, MOST)
        increasing(knots, "knots")
        reals(f["values"], "values", len(knots))
    m, n = len(maps), len(reals(model["start"], "start", 1, STATES))
    whole(model["start_samples"], "start_samples", 1, MOST)
    for j, row in enumerate(matrix(model["into"], "into", m, m + n + inputs + 1)):
        need(not any(row[j:m]), "into: a map should use earlier ones only")
    matrix(model["next"], "next", n, m + n + inputs + 1)
    matrix(model["output"], "output", p, m + n + inputs + 1)
    return Sizes(n, m, p, inputs, 0)


def _cascade(model: dict[str, Any]) -> Sizes:
    _recorded(model, "a1 b1 f a2 b2", "equation")
    for key in ("y", "u"):
        signals([model[key]], key)
    M, n = len(listed(model["b1"], "b1", 1, PHASES)), 0
    for a, b in (("a1", "b1"), ("a2", "b2")):
        rows = listed(model[b], b, M, M)
        columns = len(listed(rows[0], b, 1, MOST))
        matrix(rows, b, M, columns)
        n += max(len(reals(model[a], a, 0, MOST)), columns - 1)
    need(1 <= n <= STATES, f"{n} states")
    f = members(model["f"], "f", "low spacing coefficients")
    real(f["low"], "low")
    need(real(f["spacing"], "spacing") > 0, "the spacing should be > 0")
    reals(f["coefficients"], "coefficients", 4, MOST)
    return Sizes(n, M, 1, 1, 0)


def _implicit(model: dict[str, Any]) -> Sizes:
    more = "format version kind equation period states inputs monotonicity h y u window"
    members(model, "model", more, "shift centre training bags")
    word(model["equation"], "equation", [EQUATION])
    for key, least, most in (("states", 1, IMPLICIT_STATES), ("inputs", 0, IMPLICIT_INPUTS)):
        for name in listed(model[key], key, least, most):
            text(name, key)
    need(real(model["monotonicity"], "monotonicity") > 0, "the monotonicity should be > 0")
    n, q, p = len(model["states"]), len(model["inputs"]), len(signals(model["y"], "y"))
    inputs = len(signals(model["u"], "u", 0))
    need(window(model["window"], inputs) == q, "window: one entry for each input")
    need(n % p == 0, "the outputs do not divide the states")
    polynomials(model["h"], "h", p + n + q, (p,))
    need(("shift" in model) == (p < n), "shift: exactly where there are states after v")
    if "shift" in model:
        polynomials(model["shift"], "shift", n + q, (n - p,))
    if "centre" in model:
        polynomials(model["centre"], "centre", p, (p,))
    return Sizes(n, p, p, inputs, 0)


def tree(value: Any, where: str, sizes: Sizes, forms: int | None, depth: int = 0) -> None:
    """Multipliers of a tube, `forms` matrices in a leaf, or of stability, one."""
    need(type(value) is dict, f"{where} should be an object")
    if "split" in value:
        members(value, where, "split parts")
        need(depth < SPLITS, f"{where}: more than {SPLITS} splits")
        whole(value["split"], where, 0, sizes.box - 1)
        for part in listed(value["parts"], where, 2, 2):
            tree(part, where, sizes, forms, depth + 1)
        return
    members(value, where, "N")
    if forms is None:
        matrix(value["N"], where, sizes.m + sizes.n, sizes.m)
        return
    for N in listed(value["N"], where, forms, forms):
        matrix(N, where, sizes.m + sizes.n + sizes.p, sizes.m)


def follows(value: Any, where: str, inputs: int, rows: int) -> None:
    """A level by commands."""
    members(value, where, "terms weights")
    terms = listed(value["terms"], where, 1, TERMS)
    for term in terms:
        members(term, where, "inputs of centre scale fading")
        for i in listed(term["inputs"], where, 0, FACTORS):
            whole(i, where, 0, inputs - 1)
        word(term["of"], where, ("value", "change"))
        real(term["centre"], where)
        need(real(term["scale"], where) > 0, f"{where}: scale > 0")
        need(0 <= real(term["fading"], where) < 1, f"{where}: 0 <= fading < 1")
    for row in matrix(value["weights"], where, rows, len(terms)):
        need(min(row) >= 0 and max(row) > 0, f"{where}: weights >= 0, one of a row > 0")


TUBE = "rho L P R tau half_widths level inlet assumption"
MEASURED = "measured safety_factor designed_on measured_on"  # of a level; no part of the claim


def tube(value: Any, where: str, sizes: Sizes, planned: bool) -> None:
    """One tube."""
    members(value, where, TUBE, "peak" if planned else "follows peak")
    n, p = sizes.n, sizes.p
    for name, rows, columns in (("L", n, p), ("P", n, n), ("R", p, p)):
        matrix(value[name], f"{where}.{name}", rows, columns)
    for name in ("tau", "half_widths"):
        need(min(reals(value[name], f"{where}.{name}", p)) > 0, f"{where}.{name} should be > 0")
    rho, level, inlet = (real(value[name], f"{where}.{name}") for name in ("rho", "level", "inlet"))
    need(min(inlet, level) >= 0, f"{where}: inlet >= 0 and level >= 0")
    given = value["assumption"]
    need(type(given) is dict, f"{where}.assumption should be an object")
    kind = word(given.get("kind"), f"{where}.assumption", ("fading", "energy"))
    samples = " samples" if kind == "energy" else ""
    members(given, f"{where}.assumption", f"kind {MEASURED}{samples}", "rank")
    if samples:
        whole(given["samples"], "samples", 1, COUNT)
    need((rho == 1) == (kind == "energy"), f"{where}: rho is 1 exactly for an energy")
    if "follows" in value:
        need(kind == "fading" and inlet == 0, f"{where}: only a fading level follows commands")
        follows(value["follows"], f"{where}.follows", sizes.inputs, 1)


def funnel(document: dict[str, Any], sizes: Sizes, planned: bool, boxed: bool) -> None:
    """Tubes, and what is assumed beside them. `boxed`: a box may be stated."""
    optional = "" if planned else "response cusum commands"
    required = "format version kind model settling tubes" + " policy" * planned
    members(document, "funnel", required, optional + " box" * boxed)
    head(document, "funnel", ("tube",))
    for name in ("model", "policy")[: 1 + planned]:
        digest(document[name], f"funnel.{name}")
    whole(document["settling"], "settling", 0, COUNT)
    for k, entry in enumerate(listed(document["tubes"], "tubes", 1, TUBES)):
        tube(entry, f"tube {k + 1}", sizes, planned)


def plan(document: dict[str, Any], model: dict[str, Any], tubes: list[Any]) -> None:
    """A policy around a plan of a difference equation."""
    need(model["kind"] == "difference_equation", "a plan is of a difference equation")
    members(document, "policy", "format version kind model period K L u start")
    head(document, "policy", ("tube",))
    digest(document["model"], "policy.model")
    n = len(model["a"])
    matrix(document["K"], "K", 1, n)
    L = matrix(document["L"], "L", n, 1)
    reals(document["start"], "start", n)
    period = real(document["period"], "period")
    need(period == real(model["period"], "period"), "the policy has another period")
    low, high = reals(model["u_range"], "u_range", 2)
    for row in listed(document["u"], "u", 1, PLAN):
        (u,) = reals(row, "u", 1)
        need(low <= u <= high, "a plan's input is outside the model's range")
    need(all(matrix(tube["L"], "L", n, 1) == L for tube in tubes), "L is not the policy's")


def proof_of(document: Any, where: str) -> Any:
    """The kind of what a proof file claims."""
    members(document, where, "format version claim proof")
    word(document["format"], "format", ["nlsid/proof"])
    claim = document["claim"]
    return claim.get("kind") if type(claim) is dict else None


def held(files: dict[str, tuple[str, Any]]) -> None:
    """Raise Refused unless the files (text and content, by role) are as the pages say."""
    proof = members(files["proof"][1], "proof file", "format version claim proof")
    word(proof["format"], "format", ["nlsid/proof"])
    whole(proof["version"], "version", 2, 2)
    claim = proof["claim"]
    sizes, of = model(files["model"][1]), files["model"][1]
    required = "P" if claim["kind"] == "stability" else ""
    given = members(proof["proof"], "proof", required + " multipliers" * (sizes.m > 0))
    if claim["kind"] == "stability":
        members(claim, "claim", "kind about rate")
        need(0 < real(claim["rate"], "rate") < 1, "0 < rate < 1")
        matrix(given["P"], "P", sizes.n, sizes.n)
        if sizes.m:
            tree(given["multipliers"], "multipliers", sizes, None)
        return
    members(claim, "claim", "kind about")
    planned = "policy" in files
    if "box" in files["funnel"][1]:
        sizes = replace(sizes, box=sizes.p + sizes.n + len(of.get("window", ())))
    funnel(files["funnel"][1], sizes, planned, of["kind"] == "implicit")
    tubes = files["funnel"][1]["tubes"]
    if planned:
        plan(files["policy"][1], of, tubes)
    if sizes.m:
        for entry in listed(given["multipliers"], "multipliers", len(tubes), len(tubes)):
            tree(entry, "multipliers", sizes, 1 + sizes.p)
