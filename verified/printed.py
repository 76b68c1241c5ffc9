"""Print the numbers of a theorem back into the files that it was made of, and compare the bytes.

Reads what generate.py wrote for Coq, and nothing else of it: `read` takes the terms from the text
of the theorem, `differences` puts their numbers in the places of the files that they are about.
Members that the theorem does not speak of (names, texts, trials) are kept; a number keeps the way
that it is written in (2 or 2.0, -0.0, "1/3"), if it is that number. What is compared are all bytes
of a file but white space. `words` is the same terms for the extracted checker. Standard library.
"""

import json
import re
from fractions import Fraction
from math import copysign
from typing import Any, NamedTuple

TOKEN = re.compile(r"-?\d+|[A-Za-z_][A-Za-z_0-9]*|%[a-z0-9]+|[\[\]();,]")
SPACE = re.compile(r'("(?:[^"\\]|\\.)*")|\s+')
# What comes before the terms of a constructor, for the extracted checker.
TAGS = {"None": "0", "Some": "1", "Linear": "0", "Affine": "1", "Monotone": "2", "Leaf": "0"}
TAGS |= {"Cells": "3", "Broken": "0", "Spline": "1", "Split": "1", "false": "0", "true": "1"}
TAGS |= {"Response": "0", "Peak": "1", "Energy": "2", "Fading": "3"}


class Differs(Exception):  # noqa: N818 - says where a theorem and its files differ
    """Where the theorem's numbers are not those of the file."""


class Made(NamedTuple):
    """A constructor of Coq and its terms."""

    name: str
    terms: tuple[Any, ...]


def read(text: str) -> dict[str, Any]:
    """The definitions of a generated file: numbers, lists, pairs (tuples) and constructors."""
    found: dict[str, Any] = {}
    for line in text.splitlines():
        if line.startswith("Definition "):
            name, _, term = line.removeprefix("Definition ").rstrip(".").partition(" := ")
            tokens = TOKEN.findall(term)
            if "".join(tokens) != term.replace(" ", ""):
                raise Differs(f"{name}: not a term of numbers")
            found[name.partition(" ")[0]] = _term(tokens, found)
    return found


def _term(tokens: list[str], known: dict[str, Any]) -> Any:
    """One term. An open bracket waits with the terms that are in it so far, and its commas."""
    waiting: list[tuple[str, list[Any], bool]] = []
    terms: list[Any] = []
    pair, opened = False, ""
    for token in tokens:
        if token in "([":
            waiting.append((opened, terms, pair))
            opened, terms, pair = token, [], False
        elif token in ")]":
            made: Any = terms
            if token == ")":
                made = tuple(terms) if pair else _made(terms)
            opened, terms, pair = waiting.pop()
            terms.append(made)
        elif token == ",":
            pair = True
        elif token == "%uint63":
            terms[-1] = [-(e // 2) if e % 2 else e // 2 for e in terms[-1]]
        elif token[0] in "-0123456789":
            terms.append(int(token))
        elif token not in (";", "%positive", "%nat"):
            terms.append(known[token] if token in known else Made(token, ()))
    return _made(terms)


def _made(terms: list[Any]) -> Any:
    if len(terms) > 1:
        return Made(terms[0].name, tuple(terms[1:]))
    return terms[0]


def words(term: Any) -> str:
    """Whole numbers in a row: a list begins with its length, an option with 0 or 1."""
    said: list[str] = []
    rest = [term]
    while rest:
        term = rest.pop()
        if type(term) is int:
            said.append(str(term))
        elif isinstance(term, Made):
            said.extend(TAGS[term.name] for _ in range(term.name in TAGS))
            rest.extend(reversed(term.terms))
        else:
            if type(term) is list:
                said.append(str(len(term)))
            rest.extend(reversed(term))
    return " ".join(said)


def number(term: Any) -> Any:
    """Fractions for pairs of whole numbers, lists for lists and for other pairs."""
    if type(term) is tuple and all(type(e) is int for e in term):
        value = Fraction(*term)
        if (value.numerator, value.denominator) != term:
            raise Differs(f"{term} is not in lowest terms")
        return value
    return [number(e) for e in term] if type(term) in (list, tuple) else term


def as_written(value: Any, like: Any, where: str) -> Any:
    """The theorem's value, in the way of the file; members that it does not have are the file's.

    A member that the file does not have may be None, or 1 or a list of such, as where it is absent.
    """
    if type(value) is dict and type(like) is dict:
        for key, entry in value.items():
            if key not in like and entry is not None and not set(_flat(entry)) <= {1}:
                raise Differs(f"{where}.{key} is in the theorem and not in the file")
        return {
            key: as_written(value[key], entry, f"{where}.{key}") if key in value else entry
            for key, entry in like.items()
        }
    if type(value) is list and type(like) is list and len(value) == len(like):
        return [
            as_written(a, b, f"{where}[{i}]")
            for i, (a, b) in enumerate(zip(value, like, strict=True))
        ]
    if isinstance(value, int | Fraction) and type(like) in (int, float, str):
        return _number(Fraction(value), like)
    if type(value) is str and value == like:
        return like
    raise Differs(f"{where} is another one in the theorem")


def _flat(value: Any) -> list[Any]:
    return [e for entry in value for e in _flat(entry)] if type(value) is list else [value]


def _number(value: Fraction, like: Any) -> Any:
    if type(like) is str:
        return str(value)
    if type(like) is int and value.denominator == 1:
        return int(value)
    if Fraction(float(value)) != value:
        raise Differs(f"{value} is no float64")
    return copysign(0.0, like) if value == 0 else float(value)


def _escaped(sign: str) -> str:
    """A sign of a text as JSON may write it too; those outside ASCII are in texts only."""
    return sign if sign.isascii() else json.dumps(sign)[1:-1]


def differences(documents: dict[str, Any], files: dict[str, tuple[str, Any]]) -> None:
    """Raise Differs unless the files (text and content, by role) print as these documents."""
    for role, document in documents.items():
        text, content = files[role]
        try:
            mine = json.dumps(as_written(document, content, role), separators=(",", ":"))
        except (OverflowError, ValueError) as error:
            raise Differs(f"{role}: {error}") from error
        theirs = SPACE.sub(r"\1", text)
        if not theirs.isascii():
            theirs = "".join(map(_escaped, theirs))
        if mine != theirs:
            at = next((i for i, (a, b) in enumerate(zip(mine, theirs, strict=False)) if a != b), -1)
            raise Differs(
                f"{role}: {theirs[max(at - 20, 0) : at + 20]!r} is written, and the theorem's "
                f"numbers print as {mine[max(at - 20, 0) : at + 20]!r}"
            )


def funnel(terms: dict[str, Any], files: dict[str, tuple[str, Any]]) -> dict[str, Any]:
    """The files of a continuous funnel, and its proof."""
    states, inputs, uncertain, breaks, valid, spans = terms["field"].terms
    feeds, feedback, clips = terms["policy"].terms
    knots, nominals, shapes, levels = (number(term) for term in terms["funnel"].terms)
    around = {"t": knots, "x": nominals}
    rows = [[j, *number(ends), *_maybe(span)] for (j, ends), span in valid]
    pieces = [
        [
            {"exponents": [e for e, _ in row], "coefficients": [number(c) for _, c in row]}
            for row in f
        ]
        for f in spans
    ]
    claim: dict[str, Any] = {"goal": None}
    for centre, P in _maybe(terms["goal"]):
        claim["goal"] = {"centre": number(centre), "P": number(P)}
    proof = _witness(terms["proof"], len(clips), states, files["proof"][1]["proof"]["pieces"])
    if claim["goal"] is None:
        proof["goal_multiplier"] = None
    if "turns" in terms:
        held, stated = _held(terms, len(clips), files["proof"][1])
        claim |= held
        proof |= stated
    return {
        "vector_field": {
            "states": states,
            "inputs": inputs,
            "uncertain": number(uncertain),
            "breaks": number(breaks),
            "valid": rows,
            "pieces": pieces,
        },
        "policy": {
            **around,
            "u": number(feeds),
            "K": number(feedback),
            "limits": [[i, *number(ends)] for i, ends in clips],
        },
        "funnel": {**around, "P": shapes, "rho": levels},
        "proof": {"claim": claim, "proof": proof},
    }


def composed(terms: dict[str, Any], files: dict[str, tuple[str, Any]]) -> dict[str, Any]:
    """The files of funnels that follow each other, and their proofs."""
    documents: dict[str, Any] = {"proof": {"proof": {"multipliers": number(terms["multipliers"])}}}
    parts = ("field", "policy", "funnel", "goal")
    for i, (stage, proof) in enumerate(zip(terms["stages"], terms["proofs"], strict=True), start=1):
        own = dict(zip(parts, stage.terms, strict=True)) | {"proof": proof}
        printed = funnel(own, {"proof": files[f"stage{i}.proof"]})
        documents |= {f"stage{i}.{role}": document for role, document in printed.items()}
    return documents


def _maybe(term: Made) -> tuple[Any, ...]:
    return term.terms


def _witness(term: Made, limited: int, states: int, order: list[Any]) -> dict[str, Any]:
    """The proof; its pieces in the order of the file's."""
    margin, basis, multiplier, sides, by_interval, pushed, least = term.terms
    found: dict[str, list[Any]] = {}
    kappa = []
    for k, row in enumerate(by_interval):
        kappa.append(number(row[0].terms[4]))
        for piece in row:
            if number(piece.terms[4]) != kappa[-1]:
                raise Differs("kappa of two pieces of one interval")
            printed = _piece(k, piece, limited)
            found.setdefault(_place(printed), []).append(printed)
    names = ("basis", basis), ("multiplier", multiplier), ("sides", sides)
    exponents = {
        name: [[row.count(i + 1) for i in range(states)] for row in rows] for name, rows in names
    }
    pieces = [found[_place(piece)].pop(0) for piece in order if found.get(_place(piece))]
    if any(found.values()):
        raise Differs("pieces that the file does not have")
    return {
        "margin": number(margin),
        **exponents,
        "sides": exponents["sides"] or None,
        "kappa": kappa if pushed.name == "true" else None,
        "pieces": pieces,
        "goal_multiplier": number(least),
    }


def _held(
    terms: dict[str, Any], limited: int, like: dict[str, Any]
) -> tuple[dict[str, Any], dict[str, Any]]:
    """The claim's and the proof's members about a hold and errors; 0 is nothing held."""
    period, errors, rates = (number(terms[name]) for name in ("period", "errors", "rates"))
    found: dict[str, list[Any]] = {}
    for k, row in enumerate(terms["turns"]):
        for turn in row:
            i, up, part = turn.terms
            piece = _piece(k, part, limited) | {"input": i, "sign": 1 if up.name == "true" else -1}
            if part.terms[4]:
                raise Differs("a rate piece with more than the file has")
            found.setdefault(_place(piece), []).append(_unmultiplied(piece))
    order = like["proof"].get("rate_pieces", [])
    pieces = [found[_place(piece)].pop(0) for piece in order if found.get(_place(piece))]
    if any(found.values()):
        raise Differs("rate pieces that the file does not have")
    held = {"rates": rates, "rate_pieces": pieces} if period else {}
    if not period and (any(map(any, rates)) or pieces):
        raise Differs("rates of what is not held")
    absent = "error" not in like["claim"] and not any(errors)
    return {"hold": period or None, "error": None if absent else errors}, held


def _unmultiplied(piece: dict[str, Any]) -> dict[str, Any]:
    """A piece that has no mu."""
    if piece["mu"]["shifts"]:
        raise Differs("a multiplier that the file does not have")
    return {name: value for name, value in piece.items() if name != "mu"}


def _place(piece: dict[str, Any]) -> str:
    return repr(
        [piece.get(key) for key in ("interval", "vertex", "level", "index", "input", "sign")]
        + (piece.get("mode") or [])
    )


def _piece(interval: int, piece: Made, limited: int) -> dict[str, Any]:
    depth, index, vertex, mode, _kappa, mu, columns, squares, tau = piece.terms
    (rows,) = mu.terms
    if mode >= 3**limited:
        raise Differs(f"a mode {mode} of {limited} clipped inputs")
    digits = [mode // 3**i % 3 - 1 for i in reversed(range(limited))]
    return {
        "interval": interval,
        "vertex": vertex,
        "level": depth,
        "index": index,
        "mu": {
            "shifts": [shift for shift, _ in rows],
            "start": [a for _, (a, _) in rows],
            "end": [b for _, (_, b) in rows],
        },
        "mode": digits or None,
        "tau": [{"columns": c, "squares": _squares(s)} for c, s in tau] or None,
        "columns": columns,
        "squares": _squares(squares),
    }


def _squares(term: Made) -> dict[str, Any]:
    unit, scale, factors = term.terms
    weights = [[w for w, _ in factor] for factor in factors]
    if any(row != weights[0] for row in weights):
        raise Differs("weights that differ between factors")
    rows = [[row for _, row in factor] for factor in factors]
    return {"unit": unit, "scale": scale, "weights": weights[0], "factors": rows}


def sampled(terms: dict[str, Any], _files: dict[str, tuple[str, Any]]) -> dict[str, Any]:
    """The files of a sampled funnel, and its proof."""
    exponents, coefficients, x_range, u_range = terms["model"].terms
    form, *numbers = terms["funnel"].terms
    bound, rate, gain, tube, inlet, half_widths, S, A = map(number, numbers)
    names = ("basis", "ball_basis")
    *bases, links = terms["proof"].terms
    variables = range(1, len(x_range) + 1)
    return {
        "model": {
            "exponents": exponents,
            "coefficients": number(coefficients),
            "x_range": number(x_range),
            "u_range": number(u_range),
        },
        "policy": dict(zip("uxK", map(number, terms["policy"].terms), strict=True)),
        "funnel": {
            "assumption": {"form": form.name.lower(), "bound": bound, "rate": rate, "gain": gain},
            "tube": tube,
            "inlet": inlet,
            "half_widths": half_widths,
            "S": S,
            "A": A,
        },
        "proof": {
            "proof": {
                **{
                    name: [[row.count(i) for i in variables] for row in rows]
                    for name, rows in zip(names, bases, strict=True)
                },
                "steps": [_link(link) for link in links],
            }
        },
    }


def _link(link: Made) -> dict[str, Any]:
    *numbers, tube, inlet = link.terms
    T, kappa, curvature = map(number, numbers)
    chains = {"tube": _chain(tube), "inlet": _chain(inlet)}
    return {"T": T, "kappa": kappa, "curvature": curvature, **chains}


def _chain(chain: Made) -> dict[str, Any]:
    reach, columns, squares, ball_columns, ball = chain.terms
    return {
        "reach": number(reach),
        "columns": columns,
        "squares": _squares(squares),
        "ball": {"columns": ball_columns, "squares": _squares(ball)},
    }


def near(terms: dict[str, Any], files: dict[str, tuple[str, Any]]) -> dict[str, Any]:
    """The files of a tube or of stability, and the proof."""
    documents: dict[str, Any] = {"model": _model(terms["data"], files["model"][1])}
    if "tubes" not in terms:
        return documents | {
            "proof": {
                "claim": {"rate": number(terms["rate"])},
                "proof": {"P": number(terms["storage"]), "multipliers": _tree(terms["proof"], 1)},
            }
        }
    names = ("rho", "L", "P", "R", "tau", "half_widths", "level", "inlet")
    tubes = [dict(zip(names, map(number, tube.terms), strict=True)) for tube in terms["tubes"]]
    documents["funnel"] = {"tubes": tubes}
    trees = [
        _tree(tree, 1 + len(tube["tau"])) for tree, tube in zip(terms["proofs"], tubes, strict=True)
    ]
    documents["proof"] = {"proof": {"multipliers": trees if any(trees) else None}}
    if "feedback" in terms:
        if number(terms["a"]) != documents["model"]["a"]:
            raise Differs("the plan's model is another one than the tube's")
        documents["model"]["b"] = number([terms["b0"], *terms["b"]])
        documents["model"]["c"] = number(terms["c"])
        documents["policy"] = {"K": [number(terms["feedback"])], "L": tubes[0]["L"]}
    return documents


def _tree(tree: Made, forms: int) -> Any:
    if tree.name == "Split":
        i, lower, upper = tree.terms
        return {"split": i, "parts": [_tree(lower, forms), _tree(upper, forms)]}
    stated, Ns = tree.terms
    columns = [[list(row) for row in zip(*number(N), strict=True)] for N in Ns]
    if not any(columns):
        return None
    leaf: dict[str, Any] = {"N": columns if forms > 1 else columns[0]}
    names = ("low", "high", "low_weights", "high_weights")
    for ends in _maybe(stated):
        leaf["ends"] = dict(zip(names, map(number, ends.terms), strict=True))
    return leaf


def _model(term: Made, like: dict[str, Any]) -> dict[str, Any]:
    """What two solutions under the same inputs are told apart by; the rest is the file's."""
    terms = [number(entry) for entry in term.terms]
    if term.name == "Linear":
        return {"a": terms[0]}
    if term.name == "Monotone":
        *e, a, shift = terms
        if like["kind"] == "monotone_equation":
            if shift != _moved(len(a), 1):
                raise Differs("the model does more than shift its states")
            return {"e": e, "a": [-entry for entry in a]}
        table = {(i,) + (0,) * len(a): [c] for i, c in enumerate(e, 1)}
        table |= {_unit(1 + i, 1 + len(a)): [c] for i, c in enumerate(a)}
        return {"h": _table(table, like["h"], 1 + len(a)), **_shift(shift, len(a), like)}
    if term.name == "Cells":
        maps, known = term.terms[0], terms[1:]
        if like["kind"] == "block_cascade":
            return _cascade(maps, known, like)
        rows = {
            name: [
                row + [Fraction(c) for c in whole[len(row) :]]
                for row, whole in zip(stated, like[name], strict=True)
            ]
            for name, stated in zip(("into", "next", "output"), known, strict=True)
        }
        tables = [number(f.terms[0]) for f in maps]
        points = [{"knots": [k for k, _ in f], "values": [v for _, v in f]} for f in tables]
        return {"maps": points, **rows}
    p, n, scale, ends, rows = terms
    if like["kind"] == "implicit":
        ((_, E),) = rows
        columns = {_unit(j, p + n): [row[j] for row in E] for j in range(p + n)}
        return {"h": _table(columns, like["h"], p + n), **_shift(_moved(n, p), n, like)}
    if len(like["G"]) * p != n + p:
        raise Differs("the model has another number of states")
    found = {tuple(e): C for e, C in rows}
    G = []
    for k, entry in enumerate(like["G"]):
        blocks = {e: [row[k * p : (k + 1) * p] for row in C] for e, C in found.items()}
        G.append(_table(blocks, entry, len(like["window"])))
    ranges: dict[int, list[Fraction]] = {}
    for (i, _), pair in zip(like["window"], ends, strict=True):
        offset, size = Fraction(like["u_offset"][i]), Fraction(like["u_scale"][i])
        found_ends = [offset + size * end for end in pair]
        if ranges.setdefault(i, found_ends) != found_ends:
            raise Differs(f"two ranges of input {i}")
    kept = [ranges.get(i, list(map(Fraction, row))) for i, row in enumerate(like["u_range"])]
    return {"y_scale": scale, "G": G, "u_range": kept}


def _cascade(maps: list[Made], known: list[Any], like: dict[str, Any]) -> dict[str, Any]:
    """A spline between two filters; each row of b1 by its first entry, which the file has.

    The states are v(t-1) ... v(t-n1), then the observer form of the second filter.
    """
    into, following, (out,) = known
    M, n1, n2 = len(maps), *orders(like)
    if any(f != maps[0] for f in maps) or len(following) != n1 + n2:
        raise Differs("the model has other maps or another number of states")
    low, spacing, coefficients = map(number, maps[0].terms)
    a1 = following[0][M : M + n1] if n1 else []
    a2 = [row[M + n1] for row in following[n1:]]
    first = [Fraction(row[0]) for row in like["b1"]]
    b1 = [
        [b, *(c - b * a for c, a in zip(row[M : M + n1], a1, strict=True))]
        for b, row in zip(first, into, strict=True)
    ]
    b2 = [
        [out[j], *(row[j] - out[j] * a for row, a in zip(following[n1:], a2, strict=True))]
        for j in range(M)
    ]
    made = {"a1": a1, "b1": b1, "a2": a2, "b2": b2}
    if cascade(made | {"f": None}, n1, n2) != (into, following, [out]):
        raise Differs("the model is no cascade")
    return {
        "f": {"low": low, "spacing": spacing, "coefficients": coefficients},
        **{name: _cut(value, like[name], name) for name, value in made.items()},
    }


def _cut(rows: Any, like: Any, where: str) -> Any:
    """Zeros behind what the file states are left out."""
    if rows and type(rows[0]) is list:
        return [_cut(row, other, where) for row, other in zip(rows, like, strict=True)]
    if any(rows[len(like) :]):
        raise Differs(f"{where} is longer in the theorem")
    return rows[: len(like)]


def orders(model: dict[str, Any]) -> tuple[int, int]:
    """How many states the two filters of a cascade have."""
    return tuple(max(len(model[a]), len(model[b][0]) - 1) for a, b in (("a1", "b1"), ("a2", "b2")))  # type: ignore[return-value]


def cascade(model: dict[str, Any], n1: int, n2: int) -> tuple[Any, Any, Any]:
    """Into, next and out of a cascade, by its members."""

    def padded(row: list[Any], n: int) -> list[Fraction]:
        return [Fraction(e) for e in row] + [Fraction(0)] * (n - len(row))

    def unit(i: int, n: int) -> list[Fraction]:
        return [Fraction(int(i == j)) for j in range(n)]

    def through(rows: list[Any], a: list[Fraction], n: int) -> list[list[Fraction]]:
        found = [padded(row, n + 1) for row in rows]
        return [[b * c + e for c, e in zip(a, rest, strict=True)] for b, *rest in found]

    M = len(model["b1"])
    a1, a2 = padded(model["a1"], n1), padded(model["a2"], n2)
    C, g = through(model["b1"], a1, n1), through(model["b2"], a2, n2)
    zeros = [Fraction(0)] * M
    into = [zeros + row + [Fraction(0)] * n2 for row in C]
    following = [zeros + a1 + [Fraction(0)] * n2] if n1 else []
    following += [unit(M + k, M + n1 + n2) for k in range(n1 - 1)]
    for i in range(n2):
        row = [g[j][i] for j in range(M)] + [Fraction(0)] * n1 + unit(i + 1, n2)
        row[M + n1] += a2[i]
        following.append(row)
    out = [Fraction(row[0]) for row in model["b2"]] + [Fraction(0)] * n1 + unit(0, n2)
    return into, following, [out]


def _moved(n: int, p: int) -> list[list[Fraction]]:
    """The first n - p of n states."""
    return [[Fraction(i == j) for j in range(n)] for i in range(n - p)]


def _shift(shift: list[Any], n: int, like: dict[str, Any]) -> dict[str, Any]:
    """What becomes of the states, of an implicit model."""
    if len(like["states"]) != n:
        raise Differs("the model has another number of states")
    columns = {_unit(j, n): [row[j] for row in shift] for j in range(n)}
    return {"shift": _table(columns, like["shift"], n)} if shift else {}


def _unit(i: int, n: int) -> tuple[int, ...]:
    return tuple(int(i == j) for j in range(n))


def _table(known: dict[tuple[int, ...], Any], like: dict[str, Any], size: int) -> dict[str, Any]:
    """Exponents and coefficients; those of monomials without the first `size` are the file's."""
    rows = []
    left = dict(known)
    for e, coefficients in zip(like["exponents"], like["coefficients"], strict=True):
        first = tuple(e[:size])
        inputs_only = size < len(e) and not any(first)
        given = (
            [Fraction(c) for c in coefficients]
            if inputs_only
            else [Fraction(0)] * len(coefficients)
        )
        rows.append(left.pop(first, given))
    if any(_flat(coefficients) != [0] * len(_flat(coefficients)) for coefficients in left.values()):
        raise Differs("monomials that the file does not have")
    return {"coefficients": rows}
