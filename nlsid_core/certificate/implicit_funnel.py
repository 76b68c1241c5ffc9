"""Claim: the funnel of an identified implicit model holds under its disturbance assumption.

As `discrete_funnel`, with f the root that the observer's steps end at, seen by the monitor to be
within the stated bound: |S_vv(v⁺ - v_{k+1})| ≤ R. Every root within it of a state with |x̄| ≤ s_k
has |x̄⁺| ≤ b_k, which an identity proves (`implicit_reach.prove_implicit_reach`). Form `peak`:
b_k + η ≤ s_{k+1}. Form `response`: ξ = x̄ - r has a root of its own next to that of x̄, at most D|r|
away, so b_k is proved for R + D η, and what r adds is at most e_k: b_k + e_k ≤ s_{k+1}.
Without the bound the claim is false, whatever a solver says: the equation has spurious roots.
"""

from collections.abc import Mapping, Sequence
from fractions import Fraction

import numpy as np

from nlsid_core import _json
from nlsid_core._types import FloatArray, Json
from nlsid_core.certificate import polynomial_data as data
from nlsid_core.certificate import reach
from nlsid_core.certificate.discrete_funnel import (
    CHAINS,
    refuse_box,
    refuse_misfits,
    refuse_strangers,
    refuse_T,
    statement,
)
from nlsid_core.certificate.identity import Mode
from nlsid_core.certificate.implicit_reach import (
    ImplicitLoop,
    ImplicitStepProof,
    implicit_loop,
    implicit_response,
    names_of,
    prove_implicit_reach,
    refuse_size,
    roots_between,
)
from nlsid_core.certificate.reach import Rational, rational
from nlsid_core.certificate.verdict import Decision
from nlsid_core.discrete_funnel import DiscreteFunnel, DisturbanceAssumption
from nlsid_core.errors import CertificateRejected, DocumentError
from nlsid_core.models.trapezoidal import TrapezoidalModel
from nlsid_core.tracking_policy import TrackingPolicy


class ImplicitLink:
    """One step: what its radii are inflated by, and what the disturbance adds to its reach."""

    def __init__(
        self,
        model: TrapezoidalModel,
        policy: TrackingPolicy,
        k: int,
        *,
        S: FloatArray,
        T: FloatArray,
        A: FloatArray,
        assumption: DisturbanceAssumption,
    ) -> None:
        self.loop: ImplicitLoop = implicit_loop(
            model,
            x=policy.x[k],
            u=policy.u[k],
            K=policy.K[k],
            x_next=policy.x[k + 1],
            T=T[k],
            T_next=T[k + 1],
            S_next=S[k + 1],
        )
        d, exact_T = model.joints, rational(T[k])
        self.kappa = reach.inflation(rational(S[k]) @ exact_T)
        self.kappa_rate = reach.inflation(rational(S[k + 1][d:, d:]) @ rational(T[k + 1][d:, d:]))
        self.unit: Rational = rational(S[k + 1]) @ rational(A[k]) @ exact_T
        if assumption.form not in ("response", "peak"):
            raise CertificateRejected(
                f"form {assumption.form} is not for implicit models; use response or peak"
            )
        self.assumption = assumption

    def extents(self, radius: float, roots: float) -> tuple[float, float, Fraction]:
        """|z| of the current state, |w| that the reach has to be proved for, and D."""
        bound = self.kappa_rate * Fraction(roots)
        if self.assumption.form == "peak":
            return reach.inflate(self.kappa, radius), reach.inflate(Fraction(1), bound), Fraction(0)
        response = self.kappa * Fraction(self.assumption.bound)
        D = roots_between(
            self.loop, radius=self.kappa * Fraction(radius), bound=bound, response=response
        )
        far = reach.inflate(Fraction(1), bound + D * response)
        return reach.inflate(self.kappa, radius), far, D

    def added(self, radius: float, reached: float, D: Fraction) -> Fraction:
        """What the disturbance adds to a reach."""
        if self.assumption.form == "peak":
            return Fraction(self.assumption.bound)
        return implicit_response(
            self.loop,
            self.unit,
            radius=self.kappa * Fraction(radius),
            reached=self.kappa_rate * Fraction(reached),
            D=D,
            response=self.kappa * Fraction(self.assumption.bound),
        )


def decide(claim: Json, proof: Json, about: Mapping[str, Json], mode: Mode) -> Decision:
    """Decide the funnel of the bound files."""
    if set(about) != {"model", "policy", "funnel"} or set(claim) != {"kind", "about"}:
        raise CertificateRejected("an implicit_funnel claim is about model, policy and funnel")
    model = TrapezoidalModel.from_document(about["model"], source="model")
    policy = TrackingPolicy.from_document(about["policy"], source="policy")
    funnel = DiscreteFunnel.from_document(about["funnel"], source="funnel")
    refuse_strangers(about, policy, funnel)
    refuse_misfits(model, policy, funnel)
    T, steps = _read_steps(proof, model, funnel)
    margin = prove_implicit_chains(model, policy, funnel, T, steps, mode=mode)
    found = statement(model, funnel, margin)
    watched = "every step's next rate within the stated roots of the implicit model"
    return Decision(found.statement, found.margin, (*found.assumptions, watched))


def prove_implicit_chains(
    model: TrapezoidalModel,
    policy: TrackingPolicy,
    funnel: DiscreteFunnel,
    T: FloatArray,
    steps: Mapping[str, Sequence[ImplicitStepProof]],
    *,
    mode: Mode = "exact",
) -> float:
    """Prove both chains on plain numbers; the least margin of a Gram matrix. Raises on refusal."""
    if funnel.roots is None:
        raise CertificateRejected(
            "the funnel of an implicit model bounds no roots; its equation has spurious ones"
        )
    refuse_T(T)
    refuse_size(model)
    for k in range(len(funnel) + 1):
        refuse_box(model, policy, funnel, k)
    margins = []
    for k in range(len(funnel)):
        link = ImplicitLink(
            model, policy, k, S=funnel.S, T=T, A=funnel.A, assumption=funnel.assumption
        )
        for chain, radii in zip(CHAINS, (funnel.tube, funnel.inlet), strict=True):
            step, radius = steps[chain][k], float(radii[k])
            try:
                size, bound, D = link.extents(radius, float(funnel.roots[k + 1]))
                margins.append(prove_implicit_reach(link.loop, size, bound, step, mode=mode))
                needed = Fraction(step.reach) + link.added(radius, step.reach, D)
            except CertificateRejected as refusal:
                raise type(refusal)(f"{chain}, step {k}: {refusal}") from refusal
            if step.reach < 0 or needed > Fraction(float(radii[k + 1])):
                raise CertificateRejected(
                    f"{chain}, step {k}: reach and disturbance {float(needed):.6g} exceed the next "
                    f"radius {radii[k + 1]:.6g}"
                )
    return min(margins)


def _read_steps(
    proof: Json, model: TrapezoidalModel, funnel: DiscreteFunnel
) -> tuple[FloatArray, dict[str, list[ImplicitStepProof]]]:
    data.only(proof, {"T", *CHAINS}, source="proof")
    n, N, names = len(model), len(funnel), names_of(len(model), model.joints)
    T = np.asarray(_json.array(proof, "T", (N + 1, n, n), source="proof"))
    steps: dict[str, list[ImplicitStepProof]] = {}
    for chain in CHAINS:
        entries = _json.member(proof, chain, list, source="proof")
        if len(entries) != N or not all(isinstance(entry, dict) for entry in entries):
            raise CertificateRejected(f"proof: '{chain}' should have {N} steps")
        steps[chain] = [
            _read_step(entry, names, model.joints, f"proof {chain} {k}")
            for k, entry in enumerate(entries)
        ]
    return T, steps


def _read_step(entry: Json, names: tuple[str, ...], d: int, source: str) -> ImplicitStepProof:
    known = {"reach", "gram", "multipliers", "equality_multipliers"}
    data.only(entry, known, source=source)
    grams = [
        data.read_gram(gram, names, source=f"{source} multiplier {i}")
        for i, gram in enumerate(data.read_list(entry, "multipliers", source=source))
    ]
    nu = [
        data.read_polynomial(p, names, source=f"{source} equality multiplier {i}")
        for i, p in enumerate(data.read_list(entry, "equality_multipliers", source=source))
    ]
    if len(grams) != 2 or len(nu) != d:
        raise DocumentError(f"{source}: it takes 2 multipliers and {d} equality multipliers")
    return ImplicitStepProof(
        reach=_json.number(entry, "reach", source=source),
        gram=data.read_gram(_json.member(entry, "gram", dict, source=source), names, source=source),
        multipliers=(grams[0], grams[1]),
        equality_multipliers=tuple(nu),
    )
