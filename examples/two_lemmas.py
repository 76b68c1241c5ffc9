"""Example 5.1.2 of the thesis: what Lemma 5.2 and Lemma 5.3 say of ẋ = x/2 + sin(t)/2 - x³.

    python -m examples.two_lemmas [--plot FILE]

Of sin t only |sin t| ≤ 1 is used. Figure 5.2(a): solutions never leave x² ≤ 2.65 - 1.55 t/4π.
Figure 5.2(b): V = x²/4 decays to σ = 0.36 at the rate λ = 3. At that rate the least σ there is
solves σ + √σ/2 = 8σ²: σ = ¼.
"""

import argparse
from pathlib import Path

import numpy as np
from scipy.integrate import solve_ivp

from nlsid_core.arrays import FloatArray
from nlsid_core.design.continuous.decay import prove_decay
from nlsid_core.design.continuous.lstep import LSteps
from nlsid_core.design.continuous.pieces import Proved, prove_pieces
from nlsid_core.dynamics import VectorField, constant_on
from nlsid_core.errors import Infeasible
from nlsid_core.funnels.continuous import ContinuousFunnel
from nlsid_core.policies.continuous import ContinuousPolicy
from nlsid_core.polynomial import variables
from nlsid_core.sos.search import lower_bound

END, KNOTS = 4 * np.pi, 9
FIRST, LAST = 2.65, 1.1  # W at both ends of Figure 5.2(a)
LEVEL, SIGMA, RATE = 4.0, 0.36, 3.0  # V = x²/LEVEL in Figure 5.2(b)
LEAST_SIGMA = 0.25
STEPS = 8  # of the bisection
FIELD = VectorField.from_function(
    lambda x, w: np.array([x[0] / 2 + w[0] / 2 - x[0] ** 3]), 1, 0, uncertain=[[-1, 1]]
)


def decay(sigma: float) -> float:
    """Lemma 5.3 for V = x²/4 at the rate 3: V̇ ≤ λ(σ - V) wherever σ ≤ V ≤ 1, by this margin.

    Raises Infeasible if no positive margin is proved.
    """
    x, w = variables("x w")
    V = x**2 / LEVEL
    change = V.derivative("x") * (x / 2 + w / 2 - x**3)
    domain = [1 - w**2, V - sigma, 1 - V]
    margin = lower_bound(RATE * (sigma - V) - change, domain=domain, degree=6).value
    if margin <= 0:
        raise Infeasible(f"V̇ <= λ(σ - V) is not proved: the best bound found is {margin:.3g}")
    return margin


def invariance(last: float) -> tuple[ContinuousFunnel, Proved]:
    """Lemma 5.2 for W = x² ≤ ρ(t), ρ linear from 2.65 to `last`."""
    policy, funnel = around_zero(FIRST, last)
    return funnel, prove_pieces(LSteps(FIELD), policy, funnel)


def pulled_in() -> float:
    """Lemma 5.3 for V = x²/4 at the rate 3, by the pieces of a funnel: the floor that is found."""
    proved = prove_decay(LSteps(FIELD, decay=RATE), *around_zero(LEVEL, LEVEL))
    assert proved.pieces.decay is not None
    return proved.pieces.decay[1]


def around_zero(first: float, last: float) -> tuple[ContinuousPolicy, ContinuousFunnel]:
    """No input, and W = x² ≤ ρ(t), ρ linear from `first` to `last`."""
    t = np.linspace(0, END, KNOTS)
    still = constant_on(t, np.zeros((KNOTS - 1, 1)))
    nothing = constant_on(t, np.zeros((KNOTS - 1, 0)))
    policy = ContinuousPolicy(still, nothing, constant_on(t, np.zeros((KNOTS - 1, 0, 1))), "")
    rho = first + (last - first) * t / END
    return policy, ContinuousFunnel(still, np.ones((KNOTS, 1, 1)), rho, "", "")


def solutions(starts: FloatArray, t: FloatArray) -> FloatArray:
    """x at times t from x(0) = starts: (len(starts), len(t))."""
    found = solve_ivp(
        lambda s, x: x / 2 + np.sin(s) / 2 - x**3, (t[0], t[-1]), starts, t_eval=t, rtol=1e-9,
        atol=1e-10,
    )  # fmt: skip
    return np.asarray(found.y)


def bound(t: FloatArray, V: float, start: float) -> FloatArray:
    """Thesis (5.4): V(t) ≤ σ + exp(-λ(t - τ))(V(τ) - σ)."""
    return np.asarray(SIGMA + np.exp(-RATE * (t - start)) * (V - SIGMA))


def draw(path: Path) -> None:
    """Figures 5.2(a) and 5.2(b), from what was proved here."""
    from matplotlib.figure import Figure

    funnel, proved = invariance(LAST)
    margin = decay(SIGMA)
    t = np.linspace(0, END, 1000)
    figure = Figure(figsize=(11, 4), layout="constrained")
    left, right = figure.subplots(1, 2)
    edge = np.sqrt(np.interp(t, funnel.t, funnel.rho))
    for x in solutions(np.linspace(-edge[0], edge[0], 11), t):
        left.plot(t, x, color="#9aa0a6", lw=0.8)
    for sign in (1, -1):
        left.plot(t, sign * edge, color="#1f6fb4", lw=1.8)
    left.set_ylabel("x")
    left.set_title(f"Lemma 5.2: V(t, x) = 1, margin {np.min(proved.margins):.2g} 1/s",
                   loc="left", fontsize=10)  # fmt: skip
    limit = np.sqrt(LEVEL)
    for x in solutions(np.linspace(-limit, limit, 11), t):
        right.plot(t, x, color="#9aa0a6", lw=0.8)
    for sign in (1, -1):
        right.axhline(sign * limit, color="#1f6fb4", lw=1.8)
        right.axhline(sign * limit * np.sqrt(SIGMA), color="#d9822b", lw=1.2, ls="--")
        for start in (0.0, 5.0):
            ahead = t[t >= start]
            right.plot(ahead, sign * limit * np.sqrt(bound(ahead, 1.0, start)), color="#17365d")
    right.set_ylabel("x")
    title = f"Lemma 5.3: V = 1, V = σ = {SIGMA}, decay at λ = {RATE:g}, margin {margin:.2g} 1/s"
    right.set_title(title, loc="left", fontsize=10)
    for axes in (left, right):
        axes.set_xlabel("time [s]")
        axes.grid(alpha=0.25, lw=0.5)
    figure.savefig(path, dpi=130)


def main() -> tuple[float, float]:
    """(the least σ that is proved at this rate, the least there is)."""
    low, high = 0.1, SIGMA
    decay(high)
    for _ in range(STEPS):
        middle = (low + high) / 2
        try:
            decay(middle)
        except Infeasible:
            low = middle
        else:
            high = middle
    return high, LEAST_SIGMA


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--plot", type=Path)
    arguments = parser.parse_args()
    print(main(), pulled_in())
    if arguments.plot is not None:
        draw(arguments.plot)
