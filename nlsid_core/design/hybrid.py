"""`compose_jumps`: funnels in files that jump into each other, and the proof that they do.

A jump from a funnel into its own start is a motion that is repeated for ever: a gait.
Source: docs/certificate_hybrid_funnel.md.
"""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from scipy.integrate import solve_ivp
from scipy.optimize import brentq

from nlsid_core import files, proofs
from nlsid_core.arrays import FloatArray, Json
from nlsid_core.design.compose import Stage, read_stage, write_beside
from nlsid_core.design.continuous.setting import Goal
from nlsid_core.design.jump_pieces import Crossing
from nlsid_core.designs import HYBRID
from nlsid_core.dynamics import Jump, Nominal, Rates, VectorField
from nlsid_core.errors import DataError, Infeasible

KIND = "hybrid_funnel"
SHARE = 0.9  # of how far the motion ends beyond the guard, in which the goal stays beyond it
LEAST = 1e-6  # of the goal's largest eigenvalue: along the flow nothing else may bound it
STEP = 1e-6  # of a state, for slopes of the dynamics
SAMPLES = 400  # of the motion, where its crossing is looked for


def compose_jumps(
    paths: Sequence[Path | str], jumps: Sequence[Jump | Path | str], folder: Path | str
) -> Path:
    """Bind the funnels of these proof files and the jumps between them into one claim.

    jumps: jump i leads from funnel i into the next; with as many jumps as funnels the last leads
    into the first, and what is proved is proved for ever. Copies every stage's four files and the
    jumps to `folder`, as stage1.policy.json and jump1.json and so on, and writes
    hybrid.proof.json, whose path is returned.

    Raises CertificateRejected or CertificateMismatch if a proof is not one of a funnel or its files
    are not beside it, DataError if stages and jumps do not fit together, Infeasible if a jump is
    not proved: the message says where.
    """
    if len(jumps) not in (len(paths) - 1, len(paths)) or not jumps:
        raise DataError(
            f"{len(paths)} funnels take {len(paths) - 1} jumps, or one more for a cycle; there are "
            f"{len(jumps)}"
        )
    stages = [read_stage(i, Path(path)) for i, path in enumerate(paths, start=1)]
    read = [jump if isinstance(jump, Jump) else Jump.load(jump) for jump in jumps]
    contents = {name: content for stage in stages for name, content in stage.contents.items()}
    found = []
    for i, jump in enumerate(read):
        contents[f"jump{i + 1}.json"] = files.encode(jump.document())
        found.append(_jump_proof(i + 1, jump, stages[i], stages[(i + 1) % len(stages)]))
    names = [f"stage{stage.number}.proof.json" for stage in stages]
    names += [f"jump{i}.json" for i in range(1, len(read) + 1)]
    about = {
        name.removesuffix(".json").removesuffix(".proof"): {
            "file": name, "digest": files.digest(contents[name])
        }
        for name in names
    }  # fmt: skip
    document = proofs.proof_document({"kind": KIND, "about": about}, {"jumps": found})
    proofs.decide(document, contents)
    sources = [Path(path) for path in paths]
    sources += [Path(jump) for jump in jumps if not isinstance(jump, Jump)]
    write_beside(Path(folder), contents, sources)
    files.write_document(Path(folder) / HYBRID, document)
    return Path(folder) / HYBRID


def _jump_proof(number: int, jump: Jump, before: Stage, after: Stage) -> Json:
    """The witnesses of a jump, once its parts fit together."""
    a, b = before.funnel, after.funnel
    if (a.n, b.n) != (jump.n, len(jump.reset)):
        raise DataError(
            f"jump {number} leads from {jump.n} states to {len(jump.reset)}, {before.path} has "
            f"{a.n} and {after.path} {b.n}"
        )
    if jump.start not in a.t[:-1]:
        nearest = float(a.t[np.abs(a.t[:-1] - jump.start).argmin()])
        raise DataError(
            f"jump {number} is watched from {jump.start!r} s on, which is no knot of "
            f"{before.path}: take {nearest!r} s"
        )
    try:
        return Crossing(jump, a, b).proof()
    except Infeasible as refusal:
        raise Infeasible(f"jump {number}: {refusal}") from refusal


def goal_before(
    jump: Jump,
    dynamics: VectorField | Callable[..., Any],
    nominal: Nominal,
    inlet: Goal,
) -> Goal:
    """Where a motion is to end that jumps into `inlet`, to first order in the deviation from it.

    nominal: crosses the guard after the jump's start and ends beyond it: from there on it is the
    motion as if nothing happened. A solution beside it crosses earlier or later; what it is there,
    but for a shift along the flow, the reset takes into the inlet, such as `Goal.start_of` the
    funnel after. Along the flow the goal is as wide as leaves all of it beyond the guard.

    Raises DataError if the motion does not cross the guard, or ends before it.
    """
    t, n = nominal.t, jump.n
    end = nominal.x.ends()[-1]
    beyond = float(jump.height(end[None])[0])
    when = _crossing(jump, nominal)
    if when is None or beyond >= 0:
        raise DataError(
            f"the motion should cross the guard after {jump.start:g} s and end beyond it; at its "
            f"end, {t[-1]:g} s, the guard is {beyond:.3g}"
        )
    rates = dynamics
    if not isinstance(dynamics, VectorField):
        rates = Rates.numeric(dynamics, n, nominal.u.control.shape[2])
    x, flow = nominal.x(when), nominal.x.derivative()(when)
    guard, reset = jump.slopes(x)
    to_guard = np.eye(n) - np.outer(flow, guard) / (guard @ flow)
    back = np.linalg.inv(_transition(rates, nominal, when, float(t[-1])))
    after = reset @ to_guard @ back
    slope = jump.slopes(end)[0]
    P = after.T @ inlet.P @ after + np.outer(slope, slope) / (SHARE * beyond) ** 2
    P += LEAST * float(np.linalg.eigvalsh(P)[-1]) * np.eye(n)
    return Goal(end, (P + P.T) / 2)


def _crossing(jump: Jump, nominal: Nominal) -> float | None:
    """s, when the motion first crosses the guard from its start on."""
    t = np.linspace(jump.start, float(nominal.t[-1]), SAMPLES)
    heights = jump.height(nominal.x(t))
    below = np.flatnonzero(heights <= 0)
    if not len(below) or below[0] == 0:
        return None
    first = int(below[0])
    return float(
        brentq(lambda s: float(jump.height(nominal.x(s)[None])[0]), t[first - 1], t[first])
    )


def _transition(rates: VectorField | Any, nominal: Nominal, start: float, end: float) -> FloatArray:
    """(n, n) by which a small deviation grows along the motion, its input unchanged."""
    n = nominal.x.control.shape[2]

    def slope(t: float, flat: FloatArray) -> FloatArray:
        x, u = nominal.x(t), np.tile(nominal.u(t), (2 * n, 1))
        moved = STEP * np.eye(n) * np.maximum(1.0, np.abs(x))
        f = rates(t, np.vstack([x + moved, x - moved]), u)
        A = ((f[:n] - f[n:]) / (2 * np.diag(moved))[:, None]).T
        return np.asarray((A @ flat.reshape(n, n)).ravel())

    solved = solve_ivp(slope, (start, end), np.eye(n).ravel(), rtol=1e-8, atol=1e-10)
    return np.asarray(solved.y[:, -1].reshape(n, n))
