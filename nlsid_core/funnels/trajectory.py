"""`design_funnel`: dynamics and a nominal motion in; policy, funnel and its proof out."""

import dataclasses
import time
from collections.abc import Callable
from concurrent.futures import Executor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy.linalg import solve_continuous_are

from nlsid_core import _json
from nlsid_core._types import ArrayLike, FloatArray, Json
from nlsid_core.certificate.check import proof_document
from nlsid_core.certificate.trajectory_funnel import (
    document_pieces,
    refuse_goal,
    refuse_invalid,
)
from nlsid_core.continuous import Funnel, Nominal, Policy, VectorField
from nlsid_core.continuous.funnel import ellipsoid_inside
from nlsid_core.errors import CertificateRejected, DataError, Infeasible
from nlsid_core.funnels.alternation import alternate_shape
from nlsid_core.funnels.lstep import LSteps, section_at, sections
from nlsid_core.funnels.pieces import Proved, prove_pieces, unsolved
from nlsid_core.funnels.sweep import Progress, sweep_rho
from nlsid_core.funnels.tvlqr import Tracking, lyapunov, tvlqr

GOAL_ROOM = 1.01  # S(t_f) over the goal's matrix: the funnel ends strictly inside
DEFECT = 1e-3  # of the largest |ẋ₀|: more is not this system's motion
MARGIN = 5e-4  # of the L-steps' rate scale, in the sweep, at first
RETRIES = 6
GROWTH = 4.0  # of the margin, where some piece is not proved
CAP_ROOM = 1 - 1e-6  # the checker decides in rationals what is rounded here
FILES = ("vector_field.json", "policy.json", "funnel.json", "funnel.proof.json")


@dataclass(frozen=True, eq=False)
class Goal:
    """{x : |x - centre|²_P ≤ 1}, the set to end in. centre: (n,), P: (n, n) ≻ 0."""

    centre: FloatArray
    P: FloatArray


@dataclass(frozen=True, eq=False)
class FunnelDesign:
    """A funnel that is proved for every t, its policy, and how it was found.

    margins: (pieces,) proved lower bounds of -V̇ on the boundary, in 1/s. history: (what, ∫ volume
    dt). seconds: wall clock of each stage.
    """

    field: VectorField
    policy: Policy
    funnel: Funnel
    goal: Goal
    goal_multiplier: float
    proved: Proved
    history: tuple[tuple[str, float], ...]
    seconds: dict[str, float] = dataclasses.field(default_factory=dict)

    def certificate(self, names: tuple[str, str, str] = FILES[:3]) -> Json:
        """The proof file's content, about the three files it names."""
        documents = (self.field.document(), self.policy.document(), self.funnel.document())
        roles = ("vector_field", "policy", "funnel")
        about = {
            role: {"file": name, "digest": _json.digest(document)}
            for role, name, document in zip(roles, names, documents, strict=True)
        }
        goal = {"centre": self.goal.centre.tolist(), "P": self.goal.P.tolist()}
        claim = {"kind": "trajectory_funnel", "about": about, "goal": goal}
        proof = {
            "goal_multiplier": self.goal_multiplier,
            "basis": self.proved.pieces.basis.tolist(),
            "pieces": document_pieces(self.proved.pieces),
        }
        if self.proved.pieces.kappa is not None:
            proof["kappa"] = self.proved.pieces.kappa.tolist()
        return proof_document(claim, proof)

    def save(self, folder: Path | str) -> tuple[Path, ...]:
        """Write dynamics, policy, funnel and proof; returns the four paths, the proof last."""
        folder = Path(folder)
        documents = (self.field.document(), self.policy.document(), self.funnel.document(),
                     self.certificate())  # fmt: skip
        paths = tuple(folder / name for name in FILES)
        for path, document in zip(paths, documents, strict=True):
            _json.write_document(path, document)
        return paths

    def __str__(self) -> str:
        return (
            f"funnel from {self.funnel.t0:g} to {self.funnel.tf:g} s, "
            f"{len(self.proved.pieces)} pieces proved, "
            f"margin {np.min(self.proved.margins):.3g} 1/s, "
            f"volume integral {self.funnel.volume_integral():.4g}, "
            f"{sum(self.seconds.values()):.2f} s"
        )


def design_funnel(
    dynamics: VectorField | Callable[..., Any],
    nominal: Nominal,
    *,
    goal: Goal | ArrayLike | None = None,
    policy: Policy | None = None,
    shape: str = "rho",
    Q: ArrayLike | None = None,
    R: ArrayLike | None = None,
    gain: str = "constant",
    limits: ArrayLike | None = None,
    executor: Executor | None = None,
    progress: Progress | None = None,
) -> FunnelDesign:
    """The largest funnel around `nominal` that ends in `goal`, proved for every t.

    dynamics: a VectorField, or a polynomial function of some of t, x, u, w. goal: an ellipsoid, or
    its matrix around the nominal's end; by default the largest set that the closed loop keeps at
    the end. policy: default a time-varying LQR with Q and R (default identities), and P(t) its
    cost-to-go; for a given policy P(t) solves the Lyapunov equation with Q. shape "rho": P fixed,
    ρ(t) is swept backward; "P": P(t) itself is searched, alternating, from there. gain: how the
    LQR's K varies between knots. limits: rows (input, low, high) at which inputs saturate; the
    proof then covers every mode of them. executor: shares the independent L-steps of shape "P".

    Raises DataError on input that cannot be right, Infeasible if no funnel was found or proved.
    """
    started = time.perf_counter()
    field = dynamics if isinstance(dynamics, VectorField) else VectorField.from_function(
        dynamics, nominal.x.control.shape[2], nominal.u.control.shape[2]
    )  # fmt: skip
    if shape not in ("rho", "P"):
        raise DataError(f"shape is '{shape}'; known: rho, P")
    refuse_nominal(field, nominal)
    Q = np.eye(field.n) if Q is None else np.asarray(Q, dtype=np.float64)
    R = np.eye(field.m) if R is None else np.asarray(R, dtype=np.float64)
    wanted = _wanted_goal(goal, nominal, field.n)
    tracking = _tracking(field, nominal, wanted, policy, Q, R, gain)
    policy, S = tracking.policy, tracking.S
    if limits is not None:
        policy = dataclasses.replace(policy, limits=np.asarray(limits, dtype=np.float64))
    refuse_saturated(policy, shape)
    steps = LSteps(field, policy)
    seconds = {"policy": time.perf_counter() - started}
    started = time.perf_counter()
    steps.bound_pushes(S[-1])
    rho_final, target = _final(steps, policy, S, wanted)
    funnel, proved, margin = _swept(steps, policy, S, rho_final, progress)
    history = [("rho", funnel.volume_integral())]
    seconds["rho"] = time.perf_counter() - started
    if shape == "P" and steps.kappa is not None:
        raise DataError("shape P takes w at its corners: it is for fewer than three pushes")
    if shape == "P":
        started = time.perf_counter()
        funnel, proved, steps_taken = alternate_shape(
            steps, policy, funnel, margin=margin, executor=executor, progress=progress
        )
        history += steps_taken
        seconds["P"] = time.perf_counter() - started
    end = funnel.x.ends()[-1]
    multiplier = ellipsoid_inside(end, funnel.shape(funnel.tf), target.centre, target.P)
    if multiplier is None:
        raise Infeasible("the funnel's end is not inside the goal")
    try:
        refuse_invalid(field, policy, funnel)
        refuse_goal(funnel, target.centre, target.P, multiplier)
    except CertificateRejected as refusal:
        raise Infeasible(f"{refusal}: choose another goal") from refusal
    return FunnelDesign(field, policy, funnel, target, multiplier, proved, tuple(history), seconds)


def refuse_nominal(field: VectorField, nominal: Nominal) -> None:
    """Raise unless the nominal fits the dynamics' sizes and obeys them well enough."""
    sizes = (nominal.x.control.shape[2], nominal.u.control.shape[2])
    if sizes != (field.n, field.m):
        raise DataError(
            f"the nominal has {sizes[0]} states and {sizes[1]} inputs, the dynamics {field.n} and "
            f"{field.m}"
        )
    gap, t, state = nominal.defect(field)
    scale = float(np.abs(nominal.x.derivative().control).max())
    if gap > DEFECT * max(scale, 1e-9):
        raise DataError(
            f"the nominal does not obey the dynamics: dx{state}/dt is off by {gap:.3g} at "
            f"t = {t:.6g} s (the largest rate is {scale:.3g}); use integrate_nominal "
            "or more knots"
        )


def refuse_saturated(policy: Policy, shape: str) -> None:
    """Raise unless the nominal's own inputs are within the policy's limits, and shape is rho."""
    if len(policy.limits) and shape == "P":
        raise DataError("shape P searches one polynomial at a time: with limits take shape rho")
    for i, low, high in policy.limits.tolist():
        u = policy.u.control[:, :, int(i)]
        least, most = float(np.min(u)), float(np.max(u))
        if not (low < least and most < high):
            raise DataError(
                f"the nominal's input {int(i)} needs [{least:.6g}, {most:.6g}], its limits are "
                f"[{low:g}, {high:g}]: no room is left to correct anything"
            )


def _wanted_goal(goal: Goal | ArrayLike | None, nominal: Nominal, n: int) -> Goal | None:
    if goal is None or isinstance(goal, Goal):
        wanted = goal
    else:
        wanted = Goal(nominal.x.ends()[-1], np.asarray(goal, dtype=np.float64))
    if wanted is not None:
        if wanted.P.shape != (n, n) or wanted.centre.shape != (n,):
            raise DataError(f"the goal should be an ellipsoid in {n} states")
        if not (wanted.P == wanted.P.T).all() or np.linalg.eigvalsh(wanted.P)[0] <= 0:
            raise DataError("the goal's matrix should be symmetric positive definite")
        d = nominal.x.ends()[-1] - wanted.centre
        if d @ wanted.P @ d >= 1:
            raise DataError(
                f"the nominal ends outside the goal: |x - centre|² = {d @ wanted.P @ d:.3g} > 1"
            )
    return wanted


def _tracking(
    field: VectorField,
    nominal: Nominal,
    goal: Goal | None,
    policy: Policy | None,
    Q: FloatArray,
    R: FloatArray,
    gain: str,
) -> Tracking:
    """Policy and P(t): of the LQR, or the given policy with its Lyapunov equation."""
    if goal is not None:
        final = GOAL_ROOM * goal.P
    else:
        A, B = field.jacobians(float(nominal.t[-1]), nominal.x.ends()[-1], nominal.u.ends()[-1])
        try:
            final = solve_continuous_are(A, B, Q, R)
            final = (final + final.T) / 2
        except (np.linalg.LinAlgError, ValueError) as error:
            raise Infeasible(
                "the linearisation at the nominal's end cannot be stabilised by any gain "
                f"({error}): it is uncontrollable, or Q or R is indefinite. Give a goal "
                "and a policy."
            ) from error
    if policy is None:
        return tvlqr(field, nominal, Q=Q, R=R, S_final=final, gain=gain)
    if policy.vector_field != _json.digest(field.document()):
        raise DataError("the policy was made for other dynamics")
    same = np.array_equal(policy.x.control, nominal.x.control)
    if not same or not np.array_equal(policy.t, nominal.t):
        raise DataError("the policy is around another nominal")
    return Tracking(policy, lyapunov(field, policy, Q=Q, P_final=final))


def _final(steps: LSteps, policy: Policy, S: FloatArray, goal: Goal | None) -> tuple[float, Goal]:
    """ρ(t_f) and the goal: the largest level inside a given goal, or one the end itself keeps."""
    end = policy.x.ends()[-1]
    if goal is None:
        section = section_at(steps.field, policy, S, len(S) - 2, 1.0)
        low, high = 0.0, np.inf
        rho = 1.0
        for _ in range(24):
            kept = min(s.m for s in steps.solve(section, rho)) > 0
            low, high = (rho, high) if kept else (low, rho)
            rho = 4 * low if np.isinf(high) else (high / 4 if low == 0 else (low + high) / 2)
            if low and high / low < 1.05:
                break
        if low == 0:
            raise Infeasible(
                "the closed loop keeps no set at the end: give a goal, or another Q and R"
            )
        return low, Goal(end, S[-1] / (GOAL_ROOM * low))
    low, high = 0.0, 1.0
    d = end - goal.centre
    if not d.any():
        return 1.0, goal
    for _ in range(40):
        middle = (low + high) / 2
        found = ellipsoid_inside(end, S[-1] / middle, goal.centre, goal.P)
        low, high = (low, middle) if found is None else (middle, high)
    return low * (1 - 1e-6), goal


def validity_caps(field: VectorField, policy: Policy, P: FloatArray) -> FloatArray:
    """(K,) the largest ρ at each knot with which x and u stay where the dynamics are valid.

    Raises DataError if the nominal itself does not.
    """
    caps = np.full(len(P), np.inf)
    clipped = {int(i) + field.n: (low, high) for i, low, high in policy.limits.tolist()}
    for k in range(len(P) - 1):
        for entry, low, high in field.validity(field.span(float(policy.t[k]))):
            if entry in clipped and low <= clipped[entry][0] and clipped[entry][1] <= high:
                continue
            centre, rows = policy.entry(entry, k)
            room = min(high - float(np.max(centre)), float(np.min(centre)) - low)
            if room <= 0:
                raise DataError(
                    f"the nominal leaves where its dynamics are valid: entry {entry} of (x, u) is "
                    f"{centre[0]:.4g} at {policy.t[k]:g} s, not well within [{low:g}, {high:g}]"
                )
            for knot in (k, k + 1):
                reach = np.einsum("ri,ij,rj->r", rows, np.linalg.inv(P[knot]), rows).max()
                caps[knot] = min(caps[knot], CAP_ROOM * room**2 / reach)
    return caps


def _swept(
    steps: LSteps, policy: Policy, S: FloatArray, rho_final: float, progress: Progress | None
) -> tuple[Funnel, Proved, float]:
    """ρ by the backward sweep, and its proof; with a larger margin where that fails."""
    digest = _json.digest(policy.document())
    pairs = sections(steps.field, policy, S)
    caps = validity_caps(steps.field, policy, S)
    rho_final = min(rho_final, float(caps[-1]))
    spread = steps.values(pairs[-1][1], rho_final, 0)
    margin = MARGIN * float(np.abs(spread).mean())
    proved: Proved | None = None
    for _ in range(RETRIES):
        rho, ends = sweep_rho(steps, pairs, margin=margin, rho_final=rho_final, caps=caps,
                              progress=progress)  # fmt: skip
        funnel = Funnel(policy.x, S, rho, policy.vector_field, digest)
        proved = prove_pieces(steps, policy, funnel, ends)
        if not proved.unproved:
            return funnel, proved, margin
        margin *= GROWTH
    assert proved is not None
    raise Infeasible(
        f"no proof from {unsolved(policy, proved.unproved)} although the L-steps at its "
        "knots hold: try more knots there"
    )
