"""Sampled funnels of one state written by hand: documents and proofs whose truth is known."""

import random
from dataclasses import dataclass, field
from fractions import Fraction
from math import ceil, log2
from typing import Any

from nlsid_core import proofs
from nlsid_core.kernel import Verdict

Json = dict[str, Any]
Rows = list[list[float]]
NAMES = {"model": "model.json", "policy": "policy.json", "funnel": "funnel.json"}
DIGEST = "sha256:" + 64 * "2"
UP = 1 + 1e-7  # of a bound over what is true


@dataclass
class Scalar:
    """x⁺ = Σ coefficients[e] x^e0 u^e1, N steps of x = x*, u = u*, with radii of both chains.

    reach, sigma: by chain and step, the reach, and the rows whose squares are the ball's multiplier
    in 1, x̄ T, ...; no other squares are stated. curvature: of every step. basis: the degree of its
    monomials.
    """

    coefficients: dict[tuple[int, int], float]
    x: list[float]
    u: list[float]
    K: list[float]
    S: list[float]
    A: list[float]
    tube: list[float]
    inlet: list[float]
    reach: dict[str, list[float]]
    sigma: dict[str, list[Rows]]
    form: str = "response"
    bound: float = 0.0
    measured: float = 0.0
    rate: float = 1.0
    gain: float = 1.0
    curvature: list[float] = field(default_factory=lambda: [0.0])
    box: float = 2.0**120
    widths: list[float] | None = None
    runs: list[str] = field(default_factory=lambda: [DIGEST])
    period: float = 0.5
    name: str = "level"
    basis: int = 1

    def documents(self) -> dict[str, Json]:
        """Model, policy and funnel, by role."""
        box = [[-self.box, self.box]]
        model = {
            "format": "nlsid/model",
            "version": 2,
            "kind": "state_map",
            "equation": "",
            "period": self.period,
            "x": [{"name": self.name, "unit": "m", "path": ""}],
            "u": [{"name": "input", "unit": "", "path": ""}],
            "exponents": [list(e) for e in self.coefficients],
            "coefficients": [[c] for c in self.coefficients.values()],
            "x_range": box,
            "u_range": box,
            "noise": [0.0],
            "disturbance": [0.0],
            "bags": [{"name": "fit", "digest": "sha256:" + 64 * "1"}],
        }
        bind = proofs.binding
        policy = {
            "format": "nlsid/policy",
            "version": 2,
            "kind": "sampled",
            "law": "",
            "model": bind("", model)["digest"],
            "period": self.period,
            "L": [[1.0]],
            "u": [[u] for u in self.u],
            "x": [[x] for x in self.x],
            "K": [[[k]] for k in self.K],
        }
        exact = [
            (Fraction(r) + Fraction(self.bound)) / Fraction(s or 1.0)
            for r, s in zip(self.tube, self.S, strict=True)
        ]
        widths = self.widths or [float(w) * (1 + 2.0**-50) for w in exact]
        funnel = {
            "format": "nlsid/funnel",
            "version": 2,
            "kind": "sampled",
            "set": "",
            "model": policy["model"],
            "policy": bind("", policy)["digest"],
            "assumption": {
                "form": self.form,
                "bound": self.bound,
                "rate": self.rate,
                "gain": self.gain,
                "measured": self.measured,
                "safety_factor": 1.0,
                "measured_on": [{"name": "run", "digest": d} for d in self.runs],
            },
            "tube": self.tube,
            "inlet": self.inlet,
            "half_widths": [[w] for w in widths],
            "S": [[[s]] for s in self.S],
            "A": [[[a]] for a in self.A],
        }
        return {"model": model, "policy": policy, "funnel": funnel}

    def T(self, k: int) -> float:
        """The power of two nearest to 1/S."""
        return float(2.0 ** -round(log2(self.S[k] or 1.0)))

    def proof(self) -> Json:
        """The witnesses."""
        steps = []
        for k in range(len(self.u)):
            T = self.T(k)
            kappa = 1 / (Fraction(self.S[k] or 1.0) * Fraction(T))
            entry: Json = {
                "T": [[T]],
                "kappa": float(kappa) * (1 + 2.0**-50),
                "curvature": self.curvature,
            }
            for chain in ("tube", "inlet"):
                entry[chain] = {
                    "reach": self.reach[chain][k],
                    "columns": [0] * (self.basis + 1),
                    "squares": _squares([]),
                    "ball": {
                        "columns": [0] * self.basis,
                        "squares": _squares(self.sigma[chain][k]),
                    },
                }
            steps.append(entry)
        return {
            "basis": [[i] for i in range(self.basis + 1)],
            "ball_basis": [[i] for i in range(self.basis)],
            "steps": steps,
        }

    def decide(self, **changes: Any) -> Verdict:
        """The kernel's verdict; changes: documents by role, or `proof`, in the place of these."""
        documents = self.documents() | {k: v for k, v in changes.items() if k in NAMES}
        about = {role: proofs.binding(NAMES[role], documents[role]) for role in NAMES}
        claim = {"kind": "sampled_funnel", "about": about}
        document = proofs.proof_document(claim, changes.get("proof", self.proof()))
        return proofs.decide(document, {NAMES[role]: documents[role] for role in NAMES})


def _squares(rows: Rows) -> Json:
    """Rows as whole numbers over 2^40, rounded up."""
    return {"unit": 40, "factors": [[[ceil(v * 2**40) for v in row] for row in rows]]}


def one_step(rng: random.Random, room: float) -> tuple[Scalar, bool]:
    """x⁺ = a x + b u, one step; and whether its claim is true, from the closed form in Fractions.

    room: by which part the claim is on the safe side of what is true; negative if it is false.
    """
    a, b, k, A = (rng.uniform(-1.0, 1.0) for _ in range(4))
    S, S_next = rng.uniform(1.0, 1.9), rng.uniform(0.3, 0.45)
    s, bound = rng.uniform(0.5, 2.0), rng.uniform(0.01, 0.5)
    slope, ratio = Fraction(a) - Fraction(b) * Fraction(k), Fraction(S_next) / Fraction(S)
    mu, off = abs(slope) * ratio, abs(slope - Fraction(A)) * ratio  # of |x̄|, and of |r|
    added = off * Fraction(bound)
    needed = mu * Fraction(s) + added
    after = float(needed) * (1 + room)
    reach = min(float(mu) * s * UP, float(Fraction(after) - added))  # claims what it needs
    chains = ("tube", "inlet")
    claim = Scalar(
        {(1, 0): a, (0, 1): b},
        x=[0.0, 0.0],
        u=[0.0],
        K=[k],
        S=[S, S_next],
        A=[A],
        tube=[s, after],
        inlet=[s, after],
        reach={chain: [reach] for chain in chains},
        sigma={chain: [[[float(mu)]]] for chain in chains},
        bound=bound,
        measured=bound,
    )
    claim.curvature = [float(off) * UP * S * claim.T(0)]
    return claim, needed <= Fraction(after)
