"""Hold the files of a funnel, of a tube or of stability to docs/certificate*.md, by members.

What the theorems do not speak of is decided here, and nothing else: which members there are, their
types, sizes and limits, names, trials, what follows commands, the numbers of a plan.
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
TRIAL = re.compile(r"(sha256:[0-9a-f]{64})(?:\[([0-9]{1,12}):([0-9]{1,12})\])?\Z")
DEGREES = 63
PHASES = 8
TEXT, STATES, SIGNALS, POWER, SPLITS = 200, 120, 50, 20, 40
ORDER = 200  # of a matrix
IMPLICIT_STATES, IMPLICIT_INPUTS = 30, 60
MONOMIALS, TRIALS, TUBES, TERMS, FACTORS = 20_000, 10**5, 8, 200, 4
COUNT, PLAN, END, MOST = 10**9, 10**6, 10**12, 2**53
RATIONAL = re.compile(r"-?[0-9]+(?:/[0-9]*[1-9][0-9]*)?\Z")
WHOLE = re.compile(r"-?[0-9]+\Z")
COMMON = 10_000  # bits
BYTES, TOGETHER = 32 * 2**20, 48 * 2**20  # of a file, of all of a claim
DIGITS, SHIFT, LEVEL, LIMITS, DEGREE = 4000, 400, 16, 3, 7
BASIS, FACTORS_OF_SQUARES, ROWS = 200, 24, 800
KNOTS, PIECES, UNCERTAIN, ENTRIES = 10_000, 100_000, 32, 16
SAMPLES, CURVATURE, STEP_MONOMIALS, STAGES = 10**6, 64, 1000, 100
SIGNAL = "name unit path"
EQUATION = "0 = h(v, x, w), x+ = [v; shift(x, w)]"


class Refused(Exception):  # noqa: N818 - says what the pages do not allow
    """What in the files is not as the pages say."""


@dataclass(frozen=True)
class Sizes:
    """n states, m unknowns, p outputs, recorded inputs, and entries of a box that may be split.

    ends: bounds of the leading coefficient may be stated.
    """

    n: int
    m: int
    p: int
    inputs: int
    box: int
    ends: bool = False


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


def word(value: Any, where: str, allowed: Iterable[str]) -> str:
    need(type(value) is str and value in allowed, f"{where} should be one of {' '.join(allowed)}")
    return str(value)


def digest(value: Any, where: str) -> None:
    need(type(value) is str and DIGEST.match(value) is not None, f"{where} should be a digest")


def head(document: Any, where: str, kinds: Iterable[str]) -> None:
    word(document.get("format"), f"{where}'s format", [f"nlsid/{where}"])
    whole(document.get("version"), f"{where}'s version", 2, 2)
    word(document.get("kind"), f"{where}'s kind", kinds)


def trials(value: Any, where: str, least: int = 0) -> list[tuple[str, int, int]]:
    """The recording of each, its first sample and the one after its last."""
    found: list[tuple[str, int, int]] = []
    for trial in listed(value, where, least, TRIALS):
        members(trial, where, "name digest")
        text(trial["name"], where)
        given = TRIAL.match(trial["digest"]) if type(trial["digest"]) is str else None
        if given is None:
            raise Refused(f"{where}: {trial['digest']!r} is no digest of a recording or window")
        first, end = (0, END) if given[2] is None else (int(given[2]), int(given[3]))
        need(first < end and (given[2] is None or end < END), f"{where}: an empty window")
        found.append((given[1], first, end))
    return found


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
        "difference_equation": _difference, "state_affine": _affine,
        "monotone_equation": _monotone, "cell_network": _cells, "implicit": _implicit,
        "block_cascade": _cascade,
    }  # fmt: skip
    head(document, "model", kinds)
    need(real(document.get("period"), "period") > 0, "the period should be > 0")
    return kinds[document["kind"]](document)


RECORDED = "format version kind period y u training bags"


def _recorded(model: dict[str, Any], more: str, optional: str = "") -> None:
    members(model, "model", f"{RECORDED} {more}", optional)
    text(model.get("equation", ""), "equation")
    text(model["training"], "training")
    for bag in listed(model["bags"], "bags", 0, MOST):
        for entry in members(bag, "bags", "name digest").values():
            text(entry, "bags")


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
    leading, *others = (G["exponents"] for G in model["G"])
    ends = p == 1 and not any(any(e) for rows in others for e in rows)
    ends = ends and all(sum(e) <= 2 for e in leading) and 0 < box < ORDER
    return Sizes(lags * p, p, p, inputs, box, ends)


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
    members(value, where, "N", "ends")
    if "ends" in value:
        need(sizes.ends, f"{where}: ends are of one quadratic leading coefficient")
        names = [f"{name}{more}" for more in ("", "_weights") for name in ("low", "high")]
        ends = members(value["ends"], f"{where}.ends", " ".join(names))
        for name in names[:2]:
            real(ends[name], f"{where}.ends")
        for name in names[2:]:
            need(min(reals(ends[name], f"{where}.ends", sizes.box)) >= 0, f"{where}: weights >= 0")
    if forms is None:
        matrix(value["N"], where, sizes.m + sizes.n, sizes.m)
        return
    for N in listed(value["N"], where, forms, forms):
        matrix(N, where, sizes.m + sizes.n + sizes.p, sizes.m)


def measured(given: dict[str, Any], where: str) -> tuple[Fraction, Fraction]:
    """What was measured and its safety factor, on samples that chose nothing."""
    found, factor = real(given["measured"], where), real(given["safety_factor"], where)
    need(found >= 0 and factor >= 1, f"{where}: measured >= 0 and safety_factor >= 1")
    before = trials(given["designed_on"], f"{where}.designed_on")
    on: dict[str, list[tuple[int, int]]] = {}
    for recording, first, end in trials(given["measured_on"], f"{where}.measured_on", 1):
        on.setdefault(recording, []).append((first, end))
    shared = any(
        max(a, first) < min(b, end) for recording, a, b in before
        for first, end in on.get(recording, ())
    )  # fmt: skip
    need(not shared, f"{where}: measured on what it was designed on")
    return found, factor


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
MEASURED = "measured safety_factor designed_on measured_on"


def tube(value: Any, where: str, sizes: Sizes, planned: bool) -> None:
    """One tube."""
    members(value, where, TUBE, "peak" if planned else "follows peak")
    n, p = sizes.n, sizes.p
    for name, rows, columns in (("L", n, p), ("P", n, n), ("R", p, p)):
        matrix(value[name], f"{where}.{name}", rows, columns)
    for name in ("tau", "half_widths"):
        need(min(reals(value[name], f"{where}.{name}", p)) > 0, f"{where}.{name} should be > 0")
    rho, level, inlet = (real(value[name], f"{where}.{name}") for name in ("rho", "level", "inlet"))
    need(inlet >= 0, f"{where}: inlet >= 0")
    given = value["assumption"]
    need(type(given) is dict, f"{where}.assumption should be an object")
    kind = word(given.get("kind"), f"{where}.assumption", ("fading", "energy"))
    samples = " samples" if kind == "energy" else ""
    members(given, f"{where}.assumption", f"kind {MEASURED}{samples}")
    if samples:
        whole(given["samples"], "samples", 1, COUNT)
    need((rho == 1) == (kind == "energy"), f"{where}: rho is 1 exactly for an energy")
    found, factor = measured(given, f"{where}.assumption")
    need(level >= factor**2 * found, f"{where}: the level is below what was measured")
    if "peak" in value:
        peak = members(value["peak"], f"{where}.peak", "level measured")
        most, largest = (real(peak[name], f"{where}.peak.{name}") for name in ("level", "measured"))
        need(0 <= factor**2 * largest <= most, f"{where}: the peak is below what was measured")
    if "follows" in value:
        need(kind == "fading" and inlet == 0, f"{where}: only a fading level follows commands")
        follows(value["follows"], f"{where}.follows", sizes.inputs, 1)


def funnel(document: dict[str, Any], sizes: Sizes, planned: bool, boxed: bool) -> None:
    """Tubes, and what is assumed beside them. `boxed`: a box may be stated."""
    optional = "" if planned else "response cusum"
    required = "format version kind model settling tubes" + " policy" * planned
    members(document, "funnel", required, optional + " box" * boxed)
    head(document, "funnel", ("tube",))
    for name in ("model", "policy")[: 1 + planned]:
        digest(document[name], f"funnel.{name}")
    whole(document["settling"], "settling", 0, COUNT)
    for k, entry in enumerate(listed(document["tubes"], "tubes", 1, TUBES)):
        tube(entry, f"tube {k + 1}", sizes, planned)
    if "response" in document:
        response = members(document["response"], "response", "half_widths assumption", "follows")
        widths = reals(response["half_widths"], "response", sizes.p)
        need(min(widths) > 0, "response: half_widths > 0")
        found, factor = measured(
            members(response["assumption"], "response", MEASURED), "response.assumption"
        )
        need(found * factor <= 1, "response: more was measured than is assumed")
        if "follows" in response:
            follows(response["follows"], "response.follows", sizes.inputs, sizes.p)
    if "cusum" in document:
        cusum = members(document["cusum"], "cusum", "deviation drift threshold")
        need(min(reals(cusum["deviation"], "cusum", sizes.p)) > 0, "cusum: deviation > 0")
        need(real(cusum["threshold"], "cusum") > 0, "cusum: threshold > 0")
        need(real(cusum["drift"], "cusum") >= 0, "cusum: drift >= 0")


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


def composition(document: Any) -> list[Fraction]:
    """The multipliers between the stages."""
    members(document["claim"], "claim", "kind about")
    proof = members(document["proof"], "proof", "multipliers")
    return reals(proof["multipliers"], "multipliers", 1, STAGES - 1)


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
    trials(of.get("bags", []), "bags")
    if "box" in files["funnel"][1]:
        sizes = replace(sizes, box=sizes.p + sizes.n + len(of.get("window", ())))
    funnel(files["funnel"][1], sizes, planned, of["kind"] == "implicit")
    tubes = files["funnel"][1]["tubes"]
    if planned:
        plan(files["policy"][1], of, tubes)
    if sizes.m:
        for entry in listed(given["multipliers"], "multipliers", len(tubes), len(tubes)):
            tree(entry, "multipliers", sizes, 1 + sizes.p)


def rational(value: Any, where: str) -> Fraction:
    """A number, or a text p/q."""
    if type(value) is not str:
        return real(value, where)
    need(RATIONAL.match(value) is not None, f"{where}: no fraction")
    need(max(map(len, value.lstrip("-").split("/"))) <= DIGITS, f"{where}: too many digits")
    return Fraction(value)


def wide(value: Any, where: str) -> int:
    """A whole number, or a text of one."""
    if type(value) is not str:
        return whole(value, where, -MOST, MOST)
    need(len(value) <= DIGITS and WHOLE.match(value) is not None, f"{where}: no whole number")
    return int(value)


def increasing(values: list[Any], where: str) -> None:
    need(all(a < b for a, b in pairwise(values)), f"{where} should increase")


def monomials(value: Any, where: str, n: int, degree: int = DEGREES) -> list[list[int]]:
    """Distinct ones of n variables."""
    rows = listed(value, where, 0, MONOMIALS)
    for row in rows:
        for entry in listed(row, where, n, n):
            whole(entry, where, 0, degree)
        need(sum(row) <= degree, f"{where}: a degree above {degree}")
    need(len({tuple(row) for row in rows}) == len(rows), f"{where}: a monomial twice")
    return rows


def basis(value: Any, where: str, n: int) -> int:
    """The number of its monomials."""
    return len(monomials(listed(value, where, 1, BASIS), where, n, 31))


def squares(entry: dict[str, Any], where: str, k: int) -> None:
    """Columns and a sum of squares of k monomials."""
    for shift in listed(entry["columns"], where, k, k):
        whole(shift, where, -SHIFT, SHIFT)
    stated = members(entry["squares"], where, "unit factors", "scale weights")
    whole(stated["unit"], where, 0, SHIFT)
    need(wide(stated.get("scale", 1), where) > 0, f"{where}: scale > 0")
    factors = listed(stated["factors"], where, 1, FACTORS_OF_SQUARES)
    for factor in factors:
        for row in listed(factor, where, 0, ROWS):
            for number in listed(row, where, 1, k):
                wide(number, where)
    if "weights" in stated:
        weights = listed(stated["weights"], where, 0, ROWS)
        need(all(wide(weight, where) >= 0 for weight in weights), f"{where}: weights >= 0")
        need(all(len(factor) == len(weights) for factor in factors), f"{where}: a weight a row")


def vector_field(document: Any) -> tuple[int, int, int]:
    """n, m and the number of uncertain inputs."""
    members(document, "vector_field",
            "format version states inputs uncertain breaks valid expansion pieces")  # fmt: skip
    word(document["format"], "format", ["nlsid/vector_field"])
    n = whole(document["states"], "states", 1, ENTRIES)
    m = whole(document["inputs"], "inputs", 0, ENTRIES)
    box = listed(document["uncertain"], "uncertain", 0, UNCERTAIN)
    for low, high in (reals(row, "uncertain", 2) for row in box):
        need(low <= high, "uncertain: low > high")
    breaks = reals(document["breaks"], "breaks", 0, 1000)
    increasing(breaks, "breaks")
    text(document["expansion"], "expansion")
    for row in listed(document["valid"], "valid", 0, KNOTS):
        j, _, _, *span = reals(row, "valid", 3, 4)
        need(j.denominator == 1 and 0 <= j < n + m, "valid: no such entry of (x, u)")
        need(all(k.denominator == 1 and 0 <= k <= len(breaks) for k in span), "valid: no such span")
    for piece in listed(document["pieces"], "pieces", len(breaks) + 1, len(breaks) + 1):
        for equation in listed(piece, "equations", n, n):
            members(equation, "equation", "exponents coefficients")
            rows = listed(equation["exponents"], "exponents", 0, MONOMIALS)
            for row in rows:
                listed(row, "exponents", 1 + n + m + len(box), 1 + n + m + len(box))
                need(sum(whole(e, "exponents", 0, DEGREE) for e in row) <= DEGREE, "a degree")
                need(all(e <= 1 for e in row[1 + n + m :]), "a power of an uncertain input")
            increasing(rows, "monomials")
            entries = listed(equation["coefficients"], "coefficients", len(rows), len(rows))
            common = math.lcm(*(rational(c, "coefficients").denominator for c in entries))
            need(common.bit_length() <= COMMON, "coefficients of too long a denominator")
    return n, m, len(box)


def flow(files: dict[str, tuple[str, Any]]) -> None:
    """Raise Refused unless the files of a continuous funnel are as its page says."""
    field, policy, funnel, document = (
        files[role][1] for role in ("vector_field", "policy", "funnel", "proof")
    )
    n, m, uncertain = vector_field(field)
    members(policy, "policy", "format version kind vector_field t x u K limits")
    members(funnel, "funnel", "format version kind vector_field policy t x P rho")
    for name, file in (("policy", policy), ("funnel", funnel)):
        head(file, name, ("continuous",))
        knots = reals(file["t"], "t", 2, KNOTS)
        increasing(knots, "knots")
        for points in listed(file["x"], "x", len(knots) - 1, len(knots) - 1):
            matrix(points, "x", len(listed(points, "x", 1, 4)), n)
    need(policy["t"] == funnel["t"] and policy["x"] == funnel["x"], "two nominals")
    intervals = len(funnel["t"]) - 1
    for points in listed(policy["u"], "u", intervals, intervals):
        matrix(points, "u", len(listed(points, "u", 1, 4)), m)
    for points in listed(policy["K"], "K", intervals, intervals):
        for K in listed(points, "K", 1, 4):
            matrix(K, "K", m, n)
    for P in listed(funnel["P"], "P", intervals + 1, intervals + 1):
        matrix(P, "P", n, n)
    reals(funnel["rho"], "rho", intervals + 1)
    rows = [reals(row, "limits", 3) for row in listed(policy["limits"], "limits", 0, LIMITS)]
    inputs = [i for i, _, _ in rows]
    need(all(i.denominator == 1 and 0 <= i < m for i in inputs), "limits: no such input")
    need(len(set(inputs)) == len(inputs), "limits: an input twice")
    need(all(low < high for _, low, high in rows), "limits: low >= high")
    claim, limits = document["claim"], len(rows)
    members(claim, "claim", "kind about", "goal hold error decay")
    if "goal" in claim:
        members(claim["goal"], "goal", "centre P")
        reals(claim["goal"]["centre"], "goal", n)
        matrix(claim["goal"]["P"], "goal", n, n)
    held, decays, errors = "hold" in claim, "decay" in claim, [Fraction(0)]
    if decays:
        members(claim["decay"], "decay", "rate floor")
        need(real(claim["decay"]["rate"], "rate") > 0, "decay: rate > 0")
        need(0 <= real(claim["decay"]["floor"], "floor") < 1, "decay: 0 <= floor < 1")
    if held:
        need(real(claim["hold"], "hold") > 0, "hold > 0")
    if "error" in claim:
        errors = reals(claim["error"], "error", n)
        need(min(errors) >= 0, "error >= 0")
    affine = all(
        e <= 1 for piece in field["pieces"] for equation in piece for row in equation["exponents"]
        for e in row[1 + n : 1 + n + m]
    )  # fmt: skip
    need(affine or not claim.keys() & {"hold", "error"}, "the equations are not affine in an input")
    required = "basis pieces" + " margin multiplier" * (not decays)
    required += " sides" * (limits > 0 or held or decays)
    required += " goal_multiplier" * ("goal" in claim) + " rates rate_pieces" * held
    proof = members(document["proof"], "proof", required, "kappa" if uncertain else "")
    if not decays:
        need(real(proof["margin"], "margin") > 0, "the margin should be > 0")
    if "goal" in claim:
        real(proof["goal_multiplier"], "goal_multiplier")
    if "kappa" in proof:
        for row in matrix(proof["kappa"], "kappa", intervals, uncertain):
            need(min(row) > 0, "kappa > 0")
    terms = 0 if decays else len(monomials(proof["multiplier"], "multiplier", n))
    sizes = basis(proof["basis"], "basis", n), terms
    sides = basis(proof["sides"], "sides", n) if limits or held or decays else 0
    modes = " mode" * (limits > 0) + " tau" * (limits > 0 or decays)
    corners = 2**m if held or any(errors) else 1

    def place(piece: dict[str, Any], vertices: int, taus: int) -> None:
        whole(piece["interval"], "interval", 0, intervals - 1)
        level = whole(piece["level"], "level", 0, LEVEL)
        whole(piece["index"], "index", 0, 2**level - 1)
        whole(piece["vertex"], "vertex", 0, vertices - 1)
        squares(piece, "piece", sizes[0])
        if limits:
            for side in listed(piece["mode"], "mode", limits, limits):
                whole(side, "mode", -1, 1)
        if taus:
            for entry in listed(piece["tau"], "tau", taus, taus):
                squares(members(entry, "tau", "columns squares"), "tau", sides)

    vertices = corners * (1 if "kappa" in proof else 2**uncertain)
    for piece in listed(proof["pieces"], "pieces", 0, PIECES):
        names = "interval vertex level index columns squares" + " mu" * (not decays)
        members(piece, "piece", names + modes)
        place(piece, vertices, limits + 2 * decays)
        if decays:
            continue
        mu = members(piece["mu"], "mu", "shifts start end")
        for name in ("shifts", "start", "end"):
            for entry in listed(mu[name], name, sizes[1], sizes[1]):
                if name == "shifts":
                    whole(entry, name, -SHIFT, SHIFT)
                else:
                    wide(entry, name)
    intervals_with = {piece["interval"] for piece in proof["pieces"]}
    need(len(intervals_with) == intervals, "an interval without a piece")
    if held:
        rates = matrix(proof["rates"], "rates", intervals, m)
        need(all(rate > 0 for row in rates for rate in row), "rates > 0")
        for piece in listed(proof["rate_pieces"], "rate_pieces", 1, PIECES):
            names = "interval vertex level index columns squares input sign tau"
            members(piece, "rate piece", names + " mode" * (limits > 0))
            whole(piece["input"], "input", 0, m - 1)
            need(whole(piece["sign"], "sign", -1, 1) != 0, "sign: -1 or 1")
            place(piece, corners * 2**uncertain, 1 + limits)


def sampled(files: dict[str, tuple[str, Any]]) -> None:
    """Raise Refused unless the files of an explicit model's sampled funnel are as its page says."""
    model, policy, funnel, document = (
        files[role][1] for role in ("model", "policy", "funnel", "proof")
    )
    n, p = _map(model)
    members(policy, "policy", "format version kind law model period L u x K")
    members(funnel, "funnel", "format version kind set model policy assumption tube inlet "
            "half_widths S A")  # fmt: skip
    for name, file in (("policy", policy), ("funnel", funnel)):
        head(file, name, ("sampled",))
    need(real(policy["period"], "period") == real(model["period"], "period"), "another period")
    N = len(matrix(policy["u"], "u", len(listed(policy["u"], "u", 1, SAMPLES)), p))
    need(N * n**3 <= SAMPLES, "too many samples")
    matrix(policy["L"], "L", n, n)
    matrix(policy["x"], "x", N + 1, n)
    for K in listed(policy["K"], "K", N, N):
        matrix(K, "K", p, n)
    radii = {name: reals(funnel[name], name, N + 1) for name in ("tube", "inlet")}
    need(radii["tube"][0] <= radii["inlet"][0], "the tube starts outside the inlet")
    matrix(funnel["half_widths"], "half_widths", N + 1, n)
    for name, count in (("S", N + 1), ("A", N)):
        for M in listed(funnel[name], name, count, count):
            matrix(M, name, n, n)
    _kept(funnel["assumption"], trials(model["bags"], "bags"))
    members(document["claim"], "claim", "kind about")
    proof = members(document["proof"], "proof", "basis ball_basis steps")
    sizes = [basis(proof[name], name, n) for name in ("basis", "ball_basis")]
    for step in listed(proof["steps"], "steps", N, N):
        members(step, "step", "T kappa curvature tube inlet")
        matrix(step["T"], "T", n, n)
        need(real(step["kappa"], "kappa") >= 0, "kappa >= 0")
        gammas = reals(step["curvature"], "curvature", 0, CURVATURE)
        need(min(gammas, default=0) >= 0, "curvature >= 0")
        for chain in (step["tube"], step["inlet"]):
            members(chain, "chain", "reach columns squares ball")
            need(real(chain["reach"], "reach") >= 0, "reach >= 0")
            squares(chain, "chain", sizes[0])
            squares(members(chain["ball"], "ball", "columns squares"), "ball", sizes[1])


def _map(model: dict[str, Any]) -> tuple[int, int]:
    """The numbers of states and inputs of an explicit model."""
    head(model, "model", ("state_map",))
    members(model, "model", "format version kind equation period x u exponents coefficients "
            "x_range u_range noise disturbance bags")  # fmt: skip
    n, p = (len(signals(model[key], key, 1, ENTRIES)) for key in "xu")
    need(real(model["period"], "period") > 0, "the period should be > 0")
    rows = listed(model["exponents"], "exponents", 1, MONOMIALS)
    table = {"exponents": rows, "coefficients": model["coefficients"]}
    polynomials(table, "model", n + p, (n,))
    degree = max(map(sum, rows))
    need(math.comb(n + degree, degree) <= STEP_MONOMIALS, "too many monomials in a step")
    matrix(model["x_range"], "x_range", n, 2)
    matrix(model["u_range"], "u_range", p, 2)
    return n, p


def _kept(given: Any, fitted: list[tuple[str, int, int]]) -> None:
    """The assumption about the disturbance; `fitted` are the model's trials."""
    names = "bound rate gain measured safety_factor"
    members(given, "assumption", f"form {names} measured_on")
    form = word(given["form"], "form", ("response", "peak", "energy", "fading"))
    bound, rate, gain, found, factor = (real(given[name], name) for name in names.split())
    need(min(bound, rate, gain, found, factor) >= 0, "assumption: a negative number")
    need(rate <= 1 <= gain, "rate <= 1, gain >= 1")
    need(rate == 1 or form == "fading", "rate is 1 but in form fading")
    need(gain == 1 or form in ("energy", "fading"), "gain is 1 in forms response and peak")
    need(factor >= 1 and factor * found <= bound, "the bound is below what was measured")
    runs = trials(given["measured_on"], "measured_on", 1)
    need(all(end == END for _, _, end in runs), "measured_on: a window is no commissioning run")
    seen = {recording for recording, _, _ in fitted}
    need(not seen & {run for run, _, _ in runs}, "measured on what the model was fitted to")
