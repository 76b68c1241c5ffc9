"""`design_funnel`: dynamics and a nominal motion in; policy, funnel and its proof out."""

import dataclasses
import time
from collections.abc import Callable
from concurrent.futures import Executor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

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
from nlsid_core.funnels.alternation import (
    OBJECTIVES,
    alternate_rho,
    alternate_shape,
    exponential_start,
    refuse_shape,
    refuse_start,
    solve_ends,
)
from nlsid_core.funnels.lstep import sections
from nlsid_core.funnels.pieces import Proved, prove_pieces, unsolved
from nlsid_core.funnels.setting import Goal, Setting, prepare, refuse_first
from nlsid_core.funnels.sweep import Ends, Progress, sweep_rho

RETRIES = 6
GROWTH = 4.0  # of the margin, where some piece is not proved
CAP_ROOM = 1 - 1e-6  # the checker decides in rationals what is rounded here
FILES = ("vector_field.json", "policy.json", "funnel.json", "funnel.proof.json")
SHAPES = ("rho", "P")
SEARCHES = ("sweep", "alternation")


@dataclass(frozen=True, eq=False)
class FunnelDesign:
    """A funnel that is proved for every t, its policy, and how it was found.

    proved.margins: (pieces,) lower bounds of -V̇ on the boundary, in 1/s. first: a first guess to
    compare with, of which nothing is proved. history: (what, ∫ volume dt). seconds: wall clock of
    each stage.
    """

    field: VectorField
    policy: Policy
    funnel: Funnel
    goal: Goal
    goal_multiplier: float
    proved: Proved
    first: Funnel
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
    search: str = "sweep",
    objective: str = "volume",
    rho: ArrayLike | None = None,
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
    cost-to-go; for a given policy P(t) solves the Lyapunov equation with Q. gain: how the
    LQR's K varies between knots. limits: rows (input, low, high) at which inputs saturate; the
    proof then covers every mode of them.

    shape "rho": P(t) stays. search "sweep": ρ(t) is swept backward; "alternation": the thesis's,
    from a first ρ (K,) if given, else from an exponential one. shape "P": P(t) itself is searched
    from there, for "volume" or for "reference", the thesis's objective. executor: shares the
    independent L-steps.

    Raises DataError on input that cannot be right, Infeasible if no funnel was found or proved.
    """
    for what, given, known in (("shape", shape, SHAPES), ("search", search, SEARCHES),
                               ("objective", objective, OBJECTIVES)):  # fmt: skip
        if given not in known:
            raise DataError(f"{what} is '{given}'; known: {', '.join(known)}")
    if rho is not None and search != "alternation":
        raise DataError("a first rho is where the alternation starts: give search='alternation'")
    started = time.perf_counter()
    setting = prepare(
        dynamics, nominal, goal=goal, policy=policy, Q=Q, R=R, gain=gain, limits=limits
    )
    steps, policy = setting.steps, setting.policy
    if shape == "P":
        refuse_shape(steps)
    seconds = {"policy": time.perf_counter() - started}
    started = time.perf_counter()
    if search == "sweep":
        funnel, proved, margin = _swept(setting, progress)
    else:
        first = None if rho is None else np.asarray(rho, dtype=np.float64)
        funnel, proved, margin = _alternated(setting, first, executor)
    history = [("rho", funnel.volume_integral())]
    seconds["rho"] = time.perf_counter() - started
    if shape == "P":
        started = time.perf_counter()
        funnel, proved, steps_taken = alternate_shape(
            steps, policy, funnel, margin=margin, objective=objective, executor=executor,
            progress=progress,
        )  # fmt: skip
        history += steps_taken
        seconds["P"] = time.perf_counter() - started
    target = setting.goal
    end = funnel.x.ends()[-1]
    multiplier = ellipsoid_inside(end, funnel.shape(funnel.tf), target.centre, target.P)
    if multiplier is None:
        raise Infeasible("the funnel's end is not inside the goal")
    try:
        refuse_invalid(steps.field, policy, funnel)
        refuse_goal(funnel, target.centre, target.P, multiplier)
    except CertificateRejected as refusal:
        raise Infeasible(f"{refusal}: choose another goal") from refusal
    return FunnelDesign(
        field=steps.field,
        policy=policy,
        funnel=funnel,
        goal=target,
        goal_multiplier=multiplier,
        proved=proved,
        first=setting.first_guess(),
        history=tuple(history),
        seconds=seconds,
    )


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


def _swept(setting: Setting, progress: Progress | None) -> tuple[Funnel, Proved, float]:
    """ρ by the backward sweep, and its proof; with a larger margin where that fails."""
    steps, policy, P = setting.steps, setting.policy, setting.P
    pairs = sections(steps.field, policy, P)
    caps = validity_caps(steps.field, policy, P)
    rho_final = min(setting.rho_final, float(caps[-1]))

    def search(margin: float) -> tuple[FloatArray, list[Ends] | None]:
        return sweep_rho(steps, pairs, margin=margin, rho_final=rho_final, caps=caps,
                         progress=progress)  # fmt: skip

    return _proved(setting, rho_final, search)


def _alternated(
    setting: Setting, first: FloatArray | None, executor: Executor | None
) -> tuple[Funnel, Proved, float]:
    """ρ by the thesis's alternation, and its proof; with a larger margin where that fails."""
    steps, policy, P = setting.steps, setting.policy, setting.P
    if len(steps.field.valid):
        raise DataError("the alternation does not know where dynamics are valid: take the sweep")
    refuse_shape(steps)
    if first is None:
        start = exponential_start(steps, policy, P, rho_final=setting.rho_final)
    else:
        refuse_first(setting, first)
        start = Funnel(policy.x, P, first, policy.vector_field, "")
        refuse_start(start, solve_ends(steps, policy, start, executor=executor))

    def search(margin: float) -> tuple[FloatArray, list[Ends] | None]:
        found = alternate_rho(steps, policy, start, margin=margin, executor=executor)
        return found.funnel.rho, None

    return _proved(setting, float(start.rho[-1]), search)


def _proved(
    setting: Setting,
    rho_final: float,
    search: Callable[[float], tuple[FloatArray, list[Ends] | None]],
) -> tuple[Funnel, Proved, float]:
    """The ρ that `search` finds for a margin, and its proof; margins grow until there is one."""
    steps, policy = setting.steps, setting.policy
    digest = _json.digest(policy.document())
    margin = setting.margin(rho_final)
    proved: Proved | None = None
    for _ in range(RETRIES):
        rho, ends = search(margin)
        funnel = Funnel(policy.x, setting.P, rho, policy.vector_field, digest)
        proved = prove_pieces(steps, policy, funnel, ends)
        if not proved.unproved:
            return funnel, proved, margin
        margin *= GROWTH
    assert proved is not None
    raise Infeasible(
        f"no proof from {unsolved(policy, proved.unproved)} although the L-steps at its "
        "knots hold: try more knots there"
    )
