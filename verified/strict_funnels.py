"""Hold the files of a continuous or sampled funnel to their pages, by members: see strict.py."""

import math
import re
from fractions import Fraction
from typing import Any

from strict import (
    DEGREES,
    MONOMIALS,
    MOST,
    head,
    increasing,
    listed,
    matrix,
    members,
    need,
    polynomials,
    real,
    reals,
    signals,
    text,
    whole,
    word,
)

RATIONAL = re.compile(r"-?[0-9]+(?:/[0-9]*[1-9][0-9]*)?\Z")
WHOLE = re.compile(r"-?[0-9]+\Z")
COMMON = 10_000  # bits
DIGITS, SHIFT, LEVEL, LIMITS, DEGREE = 4000, 400, 16, 3, 7
BASIS, FACTORS_OF_SQUARES, ROWS = 200, 24, 800
KNOTS, PIECES, UNCERTAIN, ENTRIES = 10_000, 100_000, 32, 16
SAMPLES, CURVATURE, STEP_MONOMIALS, STAGES = 10**6, 64, 1000, 100


def composition(document: Any) -> list[Fraction]:
    """The multipliers between the stages."""
    members(document["claim"], "claim", "kind about")
    proof = members(document["proof"], "proof", "multipliers")
    return reals(proof["multipliers"], "multipliers", 1, STAGES - 1)


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
    stated = members(entry["squares"], where, "unit factors")
    whole(stated["unit"], where, 0, SHIFT)
    for factor in listed(stated["factors"], where, 1, FACTORS_OF_SQUARES):
        for row in listed(factor, where, 0, ROWS):
            for number in listed(row, where, 1, k):
                wide(number, where)


def vector_field(document: Any) -> tuple[int, int, int]:
    """n, m and the number of uncertain inputs."""
    members(
        document,
        "vector_field",
        "format version states inputs uncertain breaks valid expansion pieces",
    )
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
    members(claim, "claim", "kind about", "goal hold error")
    if "goal" in claim:
        members(claim["goal"], "goal", "centre P")
        reals(claim["goal"]["centre"], "goal", n)
        matrix(claim["goal"]["P"], "goal", n, n)
    held, errors = "hold" in claim, [Fraction(0)]
    if held:
        need(real(claim["hold"], "hold") > 0, "hold > 0")
    if "error" in claim:
        errors = reals(claim["error"], "error", n)
        need(min(errors) >= 0, "error >= 0")
    affine = all(
        e <= 1
        for piece in field["pieces"]
        for equation in piece
        for row in equation["exponents"]
        for e in row[1 + n : 1 + n + m]
    )
    need(affine or not claim.keys() & {"hold", "error"}, "the equations are not affine in an input")
    required = "basis pieces margin multiplier" + " sides" * (limits > 0 or held)
    required += " goal_multiplier" * ("goal" in claim) + " rates rate_pieces" * held
    proof = members(document["proof"], "proof", required, "kappa" if uncertain else "")
    need(real(proof["margin"], "margin") > 0, "the margin should be > 0")
    if "goal" in claim:
        real(proof["goal_multiplier"], "goal_multiplier")
    if "kappa" in proof:
        for row in matrix(proof["kappa"], "kappa", intervals, uncertain):
            need(min(row) > 0, "kappa > 0")
    sizes = basis(proof["basis"], "basis", n), len(monomials(proof["multiplier"], "multiplier", n))
    sides = basis(proof["sides"], "sides", n) if limits or held else 0
    modes = " mode tau" * (limits > 0)
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
        members(piece, "piece", "interval vertex level index columns squares mu" + modes)
        place(piece, vertices, limits)
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
    members(
        funnel,
        "funnel",
        "format version kind set model policy assumption tube inlet half_widths S A",
    )
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
    _kept(funnel["assumption"])
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
    members(
        model,
        "model",
        "format version kind equation period x u exponents coefficients "
        "x_range u_range noise disturbance bags",
    )
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


def _kept(given: Any) -> None:
    """The assumption about the disturbance; what was measured is no part of the claim."""
    members(given, "assumption", "form bound rate gain measured safety_factor measured_on")
    word(given["form"], "form", ("response",))
    bound, rate, gain = (real(given[name], name) for name in ("bound", "rate", "gain"))
    need(bound >= 0 and rate == gain == 1, "bound >= 0, rate and gain 1")
