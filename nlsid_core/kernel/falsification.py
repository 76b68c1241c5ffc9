"""Claim `falsification`: recorded samples that break what a tube assumes, whatever came before.

The tube's observer x̂⁺ = f(x̂, w) + L e, e = y - g(x̂, w), of a model that is affine in x̂, has over a
window of samples a … b the innovations e_k = E_k v, v = [x̂_a; 1]. With q_k = e_k'R e_k
and any weights λ, μ >= 0, a run that keeps the assumption has
    Σ w_k q_k <= c = Σ λ_k level g_k + Σ μ_k peak max(1, g_k),    w_k = μ_k + Σ_{j>=k} λ_j ρ^(j-k).
If the least of the left side over all x̂_a is above c, no run does: one definite matrix. Numbers are
rounded to BITS, and what that can hide is taken off. Why: docs/certificate_falsification.md.
"""

from collections.abc import Callable
from dataclasses import dataclass
from fractions import Fraction
from math import ceil, floor, prod

from . import text
from .decision import Decision
from .exact import (
    Matrix,
    block_diagonal,
    combined,
    congruence,
    inverse_forms,
    product,
    scaled,
    zero,
)
from .files import Node, Read, Rejected, bound_files
from .increments import MAX_POWER
from .levels import CommandLevel, Term
from .polynomials import Work
from .signals import name_label
from .trials import LONGEST, read_trial
from .tube import Tube, bounds, decide_tube

BITS = 1024  # behind the binary point, of what is rounded
ULP = Fraction(1, 2**BITS)
HIDDEN = Fraction(1, 2**64)  # part of the energy that is given up for what rounding can hide
MAX_PRODUCTS = 10**6  # of matrices and polynomials, long numbers counted several times
LONG = 11  # a product of numbers of b bits counts 1 + (b >> LONG)^2 times
MAX_TERMS = 10**5  # of a level, at all samples of a run
SLOW = "the model's polynomials take too long to evaluate at so many samples"

Step = tuple[Matrix, Matrix, Matrix, Matrix]  # C, d, A, f of one sample: ŷ = C x + d, x⁺ = A x + f


@dataclass(frozen=True)
class Window:
    """Samples of a recording: inputs u from sample `run` on, outputs y from `first` on."""

    run: int
    first: int
    u: Matrix
    y: Matrix

    @property
    def last(self) -> int:
        """The last sample of both."""
        return self.first + len(self.y) - 1


def decide(claim: Node, proof: Node, read: Read) -> Decision:
    """Decide {kind, about: {tube}, recording, tube, run, first, u, y} by {energy, peak}."""
    parts = claim.members("kind about recording tube run first u y")
    documents, digests = bound_files(parts["about"], read, "tube")
    stated = documents["tube"].document("proof", "claim proof")
    if stated["claim"].kind() != "tube":
        raise Rejected("what is falsified should be the assumption of a claim of kind tube")
    decided, model, node, tubes = decide_tube(stated["claim"], stated["proof"], read)
    digests |= {f"tube.{role}": digest for role, digest in decided.digests.items()}
    number = parts["tube"].whole(1, len(tubes))
    tube = tubes[number - 1]
    if tube.assumed.samples is not None:
        raise Rejected("what is falsified should be assumed for ever, not over some samples")
    recording = parts["recording"].members("name digest")
    trial, name = read_trial(parts["recording"]), name_label(recording["name"].text())
    if trial.end < LONGEST:
        raise Rejected("the recording should be a whole one; the window is stated by its samples")
    window = _read_window(parts, len(model.u), len(model.y))
    given = proof.members("energy peak")
    energy, peak = (given[key].array(len(window.y)) for key in ("energy", "peak"))
    if min(energy + peak) < 0 or (tube.assumed.peak is None and any(peak)):
        raise Rejected("weights should be 0 or more, and 0 of a peak that the tube does not assume")
    work = Work(MAX_PRODUCTS)
    least = _least(_steps(node, window, work), tube, window, _weights(tube.rho, energy, peak), work)
    most = _most(tube, window, energy, peak)
    if not least > most > 0:
        raise Rejected("a state of the observer can explain these samples, for all that is shown")
    energy_bound, *peak_bound = bounds(model, tube)
    broken = [energy_bound] * any(energy) + peak_bound * any(peak)
    span = text.below((len(window.y) - 1) * model.period)
    runs = "every run of the tube's observer through them"
    if any(energy):
        runs += f" that counts E from sample {window.first} or before"
    if tube.assumed.follows is not None:
        runs += f", g counted from sample {window.run},"
    return Decision(
        f"the assumption of tube {number} of {digests['tube']} on {name}, samples {window.first} "
        f"to {window.last}, which span {span} s: whatever the observer's state at sample "
        f"{window.first}, {runs} breaks {' or '.join(broken)}",
        least / most - 1,
        (
            f"samples {window.run} to {window.last} of the recording {trial.recording} are those "
            "that the file states",
        ),
        digests,
    )


def _read_window(parts: dict[str, Node], inputs: int, outputs: int) -> Window:
    run, first = (parts[key].whole(0) for key in ("run", "first"))
    u, y = parts["u"].array(None, inputs), parts["y"].array(None, outputs)
    if not y or first < run or len(u) != first - run + len(y):
        raise Rejected("the inputs should go from sample `run` to the last one of the outputs")
    return Window(run, first, u, y)


def _weights(rho: Fraction, energy: list[Fraction], peak: list[Fraction]) -> list[Fraction]:
    """w_k, rounded down."""
    found, later = [], Fraction(0)
    for now, single in zip(reversed(energy), reversed(peak), strict=True):
        later = now + rho * later
        later = floor(later / ULP) * ULP
        found.append(single + later)
    return found[::-1]


def _least(
    step: Callable[[int], Step], tube: Tube, window: Window, weights: list[Fraction], work: Work
) -> Fraction:
    """A number that Σ w_k q_k is not below, whatever the observer's state x̂_a.

    x̂_k = X v and e_k = E v are rounded; their entries are within `error` and `off` of the true
    ones. With Δ what they are off, |(E + Δ)v|² >= (1 - HIDDEN) |E v|² - |Δ v|²/HIDDEN, in the norm
    of R, and |Δ v|² <= trace(R) p (n + 1) off² |v|².
    """
    n, p = len(tube.P), len(tube.R)
    X = [[Fraction(int(i == j)) for j in range(n + 1)] for i in range(n)]
    Q, error, lost = zero(n + 1), Fraction(0), Fraction(0)
    size = (n + 1) ** 2 * (n + p)
    work.spend(size * len(window.y), "the window has too many samples to decide")
    for k, (y, weight) in enumerate(zip(window.y, weights, strict=True), window.first):
        C, d, A, f = step(k)
        longest = max(_bits(M) for M in (C, d, A, f, [y], tube.L, tube.R))
        work.spend(size * (longest >> LONG) ** 2, "the model's steps have too long numbers")
        E = combined(_last(n, [[a - b[0]] for a, b in zip(y, d, strict=True)]), product(C, X), -1)
        off = _size(C) * error + ULP
        Q = combined(Q, congruence(_rounded(E), tube.R), weight)
        lost += weight * off**2
        X = _rounded(combined(combined(product(A, X), product(tube.L, E)), _last(n, f)))
        error = _up(_size(combined(A, product(tube.L, C), -1)) * error) + ULP
        if error > 1:  # so that X, which grows as it does, has no long numbers either
            raise Rejected("the window is too long: rounding could hide its state")
    lost *= sum((tube.R[i][i] for i in range(p)), Fraction(0)) * p * (n + 1) / HIDDEN
    ones = block_diagonal(*[[[Fraction(1)]]] * (n + 1))
    Q = combined(scaled(Q, 1 - HIDDEN), ones, -lost)
    free, mixed = [row[:n] for row in Q[:n]], [row[n] for row in Q[:n]]
    (fitted,) = inverse_forms(free, [mixed], "the energy as a form in the observer's state")
    return Q[n][n] - fitted


def _most(tube: Tube, window: Window, energy: list[Fraction], peak: list[Fraction]) -> Fraction:
    """c, what a run that keeps the assumption has at most."""
    gs = [Fraction(1)] * len(window.y)
    if tube.assumed.follows is not None:
        gs = _levels(tube.assumed.follows, window.u)[-len(window.y) :]
    single = tube.assumed.peak[0] if tube.assumed.peak else Fraction(0)
    return sum(
        (a * tube.assumed.level * g + b * single * max(Fraction(1), g)
         for a, b, g in zip(energy, peak, gs, strict=True)), Fraction(0),
    )  # fmt: skip


def _levels(level: CommandLevel, u: Matrix) -> list[Fraction]:
    """g at every sample of the run, rounded up."""
    if len(u) * len(level.terms) > MAX_TERMS:
        raise Rejected("the run is too long for a level of so many terms")
    found = [Fraction(0)] * len(u)
    for term, weight in zip(level.terms, level.weights[0], strict=True):
        G, before = Fraction(0), _driven(term, u[0])
        for k, now in enumerate(u):
            s = _driven(term, now)
            v = (s - (before if term.change else term.centre)) / term.scale
            G, before = _up(term.fading * G + v**2), s
            found[k] += weight * G
    return found


def _driven(term: Term, u: list[Fraction]) -> Fraction:
    return prod((u[i] for i in term.inputs), start=Fraction(1))


def _steps(model: Node, window: Window, work: Work) -> Callable[[int], Step]:
    """What takes the model's state from one sample to the next, of a model affine in it."""
    kind = model.kind()
    if kind == "difference_equation":
        return _difference_equation(model, window)
    if kind == "state_affine":
        return _state_affine(model, window, work)
    raise Rejected(f"a falsification is for models affine in their states, not of kind {kind}")


def _difference_equation(model: Node, window: Window) -> Callable[[int], Step]:
    """ŷ = x_1 + b_0 u + c, x⁺ = a ŷ + shift(x) + b_1..n u."""
    a, b = model.member("a").array(None), model.member("b").array(None)
    c, n = model.member("c").number(), len(a)
    C = [[Fraction(int(j == 0)) for j in range(n)]]
    A = [[a[i] if j == 0 else Fraction(int(j == i + 1)) for j in range(n)] for i in range(n)]

    def step(k: int) -> Step:
        (u,) = window.u[k - window.run]
        d = b[0] * u + c
        return C, [[d]], A, [[a_i * d + b_i * u] for a_i, b_i in zip(a, b[1:], strict=True)]

    return step


def _state_affine(model: Node, window: Window, work: Work) -> Callable[[int], Step]:
    """0 = G_0(w) ȳ + Σ_k G_k(w) x_k + p(w), ŷ = y_scale ȳ + y_offset, x⁺ = [ȳ; x but its last]."""
    y_offset, y_scale, u_offset, u_scale = (
        model.member(key).array(None) for key in ("y_offset", "y_scale", "u_offset", "u_scale")
    )
    p, ranges = len(y_scale), model.member("u_range").array(None, 2)
    places = model.member("window").wholes(None, 2)
    refuses = model.member("on_out_of_range").text() == "refuse"
    parts = [
        (node.member("exponents").wholes(None, len(places)), node.member("coefficients"))
        for node in (*model.member("G").items(), model.member("p"))
    ]
    blocks = [
        (powers, given.array(None, p, p) if i < len(parts) - 1 else
         [[[c] for c in row] for row in given.array(None, p)])
        for i, (powers, given) in enumerate(parts)
    ]  # fmt: skip
    n = p * (len(blocks) - 2)

    def scaled_input(k: int, i: int) -> Fraction:
        if k < window.run:
            raise Rejected("the inputs should begin earlier: the model's window reaches back")
        u, (low, high) = window.u[k - window.run][i], ranges[i]
        if refuses and not low <= u <= high:
            raise Rejected(f"input {text.exact(u)} is beyond the range that the model refuses")
        clipped: Fraction = min(max(u, low), high)
        scaled_to: Fraction = (clipped - u_offset[i]) / u_scale[i]
        return scaled_to

    def step(k: int) -> Step:
        w = [scaled_input(k - delay, i) for i, delay in places]
        values = [_value(powers, c, w, work) for powers, c in blocks]
        whole = [[entry for block in values[1:] for entry in block[i]] for i in range(p)]
        work.spend(p**2 * (n + p) * (1 + (p * max(map(_bits, values)) >> LONG) ** 2), SLOW)
        solved = [[-entry for entry in row] for row in _solved(values[0], whole)]
        C = [[s * entry for entry in row[:n]] for row, s in zip(solved, y_scale, strict=True)]
        d = [[s * row[n] + o] for row, s, o in zip(solved, y_scale, y_offset, strict=True)]
        shift = [[Fraction(int(j == i)) for j in range(n)] for i in range(n - p)]
        A = [row[:n] for row in solved] + shift
        return C, d, A, [[row[n]] for row in solved] + [[Fraction(0)]] * (n - p)

    return step


def _value(
    powers: list[list[int]], coefficients: list[Matrix], w: list[Fraction], work: Work
) -> Matrix:
    """A matrix polynomial at w."""
    if any(sum(row) > MAX_POWER for row in powers):
        raise Rejected(f"a falsification is for models of degree {MAX_POWER} at most")
    bits = MAX_POWER * _bits([w])
    entries = len(coefficients[0]) * len(coefficients[0][0]) + len(w)
    work.spend(len(powers) * entries * (1 + (bits >> LONG) ** 2), SLOW)
    found = scaled(coefficients[0], Fraction(0))
    for row, coefficient in zip(powers, coefficients, strict=True):
        factors = (value**power for value, power in zip(w, row, strict=True) if power)
        found = combined(found, coefficient, prod(factors, start=Fraction(1)))
    return found


def _solved(A: Matrix, B: Matrix) -> Matrix:
    """A⁻¹B, by elimination."""
    rows = [a + b for a, b in zip(A, B, strict=True)]
    for k in range(len(A)):
        at = next((i for i in range(k, len(A)) if rows[i][k]), None)
        if at is None:
            raise Rejected("the model has no next output")
        rows[k], rows[at] = rows[at], rows[k]
        rows[k] = [entry / rows[k][k] for entry in rows[k]]
        for i, row in enumerate(rows):
            if i != k and row[k]:
                rows[i] = [a - row[k] * b for a, b in zip(row, rows[k], strict=True)]
    return [row[len(A) :] for row in rows]


def _last(n: int, column: Matrix) -> Matrix:
    """The column behind n columns of zeros."""
    return [[Fraction(0)] * n + row for row in column]


def _size(M: Matrix) -> Fraction:
    """The largest sum of a row's absolute values."""
    return max(sum(map(abs, row), Fraction(0)) for row in M)


def _rounded(M: Matrix) -> Matrix:
    """The entries, each less than ULP away."""
    return [[floor(entry / ULP) * ULP for entry in row] for row in M]


def _up(value: Fraction) -> Fraction:
    return ceil(value / ULP) * ULP


def _bits(M: Matrix) -> int:
    """The longest numerator with its denominator."""
    entries = [entry for row in M for entry in row]
    return max((e.numerator.bit_length() + e.denominator.bit_length() for e in entries), default=0)
