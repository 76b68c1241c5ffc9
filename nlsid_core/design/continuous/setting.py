"""What every search for a funnel starts from: dynamics, policy, P(t), the goal and where to end.

Everything that can be wrong with what a user gives is found here, before anything slow.
"""

from dataclasses import dataclass, replace

import numpy as np

from nlsid_core import files
from nlsid_core.arrays import ArrayLike, FloatArray, IntArray, Json
from nlsid_core.design.continuous.expansion import LOWEST, Expansion
from nlsid_core.design.continuous.held import Hold, prove_rates
from nlsid_core.design.continuous.lstep import (
    LSteps,
    refuse_degree,
    section_at,
)
from nlsid_core.design.continuous.problem import ContinuousTracking, Goal
from nlsid_core.design.continuous.tvlqr import Tracking, definite, lyapunov, steady, tvlqr
from nlsid_core.design.continuous.witnesses import affine
from nlsid_core.dynamics import Nominal, Rates, VectorField
from nlsid_core.dynamics.taylor_model import DEGREE
from nlsid_core.errors import DataError, NotPolynomial
from nlsid_core.funnels.continuous import ContinuousFunnel, ellipsoid_inside
from nlsid_core.options import numbers
from nlsid_core.policies.continuous import ContinuousPolicy

MOST_KNOTS = 130  # of a motion that is given more: each takes programs of its own
GOAL_ROOM = 1.01  # S(t_f) over the goal's matrix: the funnel ends strictly inside
MARGIN = 5e-4  # of V's rate of change: L-steps solved to 1e-5 of their spread tell it from zero
QUICKER = 4.0  # times less R: feedback that acts up to twice as fast
TIME_CONSTANT = 1 / 8  # of the motion's length, in which the default feedback returns
ASYMMETRY = 1e-9  # of a goal's matrix, relative: what rounding leaves of a product
SAME_MOTION = 1e-9  # of states, relative and absolute: the motion of a policy is the one given
DEFECT = 1e-3  # of the largest |ẋ₀|: more is not this system's motion
AT_REST = 1e-9  # |ẋ₀| of a motion that stays where it is, of 1 and of |x₀| over the motion's length


@dataclass(frozen=True, eq=False)
class Setting:
    """L-steps of the dynamics, policy, P(t) (K, n, n), the goal, and the largest ρ(t_f) in it.

    expansion: for dynamics that are not polynomial; the L-steps' field is then the linearisation's.
    hold: how the input that is applied may differ from the policy's; None if it may not.
    weights: Q (n, n) and R (m, m) of the feedback.
    """

    steps: LSteps
    P: FloatArray
    rho_final: float
    goal: Goal
    weights: tuple[FloatArray, FloatArray]
    expansion: Expansion | None = None
    hold: Hold | None = None

    @property
    def policy(self) -> ContinuousPolicy:
        """The policy of the L-steps."""
        return self.steps.policy

    def rate_proof(self, funnel: ContinuousFunnel, basis: IntArray) -> Json:
        """The members of a proof about how fast the input changes in the funnel.

        basis: (k, n) of the proof's pieces.
        """
        if self.hold is None or not self.hold.period or self.hold.rates is None:
            return {}
        rates = self.hold.rates
        return {
            "rates": rates.tolist(),
            "rate_pieces": prove_rates(self.steps, funnel, rates, basis),
            "sides": affine(funnel.n).tolist(),
        }

    def margin(self, rho: float) -> float:
        """What a search leaves at first of the rate at which V changes at the end, in 1/s."""
        last = len(self.policy.t) - 2
        end = section_at(self.steps, self.P, last, 1.0)
        if self.expansion is not None:
            levels = LOWEST * rho, rho  # the end alone has cubics, or there would be no such ρ
            self.steps.local[last] = self.expansion.around(self.policy, self.P, last, levels)
        self.steps.bound_pushes(end, rho)
        return MARGIN * float(np.abs(self.steps.values(end, rho, [0])).mean())


def prepare(
    problem: ContinuousTracking, *, saturated: bool = False, settled: bool = False
) -> Setting:
    """The problem, checked and completed; see `design_funnel` for what is raised.

    saturated: whether inputs may be at their limits; else the funnel keeps them within. A given
    policy clips at its own limits. settled: whether feedback acts QUICKER, and as if the motion
    went on after its end.
    """
    if problem.policy is not None:
        problem = replace(problem, nominal=own_motion(problem.policy, problem.nominal))
    nominal = problem.nominal
    held = Hold.of(problem.hold, problem.error, nominal.x.control.shape[2])
    limits = limits_of(problem.limits, nominal.u.control.shape[2])
    refuse_saturated(nominal, limits)
    field, expansion = _dynamics(problem, held, limits[:0] if saturated else limits)
    nominal = nominal if expansion is None else expansion.nominal
    refuse_nominal(field if expansion is None else expansion.rates, nominal)
    refuse_degree(field)
    wanted = _wanted_goal(problem.goal, nominal, field.n)
    weights = default_weights(field, nominal, wanted)
    Q = definite(weights[0] if problem.Q is None else problem.Q, field.n, "Q", strict=False)
    R = definite(weights[1] if problem.R is None else problem.R, field.m, "R", strict=True)
    final = GOAL_ROOM * wanted.P
    if settled:
        R = R / QUICKER if problem.R is None else R
        final = steady(field, nominal, Q=Q, R=R, S_final=final)
    if problem.policy is None:
        linear = problem.hold is not None  # a held input may not jump
        tracking = tvlqr(field, nominal, Q=Q, R=R, S_final=final, linear=linear)
    else:
        given = replace(problem.policy, vector_field=files.digest(field.document()))
        tracking = Tracking(given, lyapunov(field, given, Q=Q, P_final=final))
    policy, S = tracking.policy, tracking.S
    if saturated:
        policy = replace(policy, limits=limits)
    refuse_saturated(nominal, policy.limits)
    pushed = field.only_pushes and (field.is_pushed or expansion is not None)
    nonlinear = None
    if expansion is not None and (pushed or not len(field.uncertain)):
        nonlinear = expansion.nonlinear_states()
    steps = LSteps(field, policy, nonlinear=nonlinear, pushed=pushed)
    if held is not None:
        held.refuse(field, policy)
    rho_final = final_level(policy, S, wanted, expansion)
    return Setting(steps, S, rho_final, wanted, (Q, R), expansion, held)


def default_weights(
    field: VectorField, nominal: Nominal, goal: Goal
) -> tuple[FloatArray, FloatArray]:
    """Q (n, n) and R (m, m) on the scale of the goal.

    Q = P/τ, and R_j = τ |B_j|²_P: a state that an input drives directly then returns with time
    constant τ, a share of the motion's length, at a cost-to-go like the goal's.
    """
    t, x, u = nominal.t, nominal.x.ends(), nominal.u.ends()
    tau = TIME_CONSTANT * float(t[-1] - t[0])
    B = np.array([field.jacobians(float(s), x[k], u[k])[1] for k, s in enumerate(t)])
    effect = np.einsum("kij,il,klj->kj", B, goal.P, B).mean(axis=0)
    effect = np.where(effect > 0, effect, np.max(effect, initial=0.0) or 1.0)
    return goal.P / tau, np.diag(tau * effect)


def limits_of(limits: ArrayLike | None, m: int) -> FloatArray:
    """(L, 3) rows (input, low, high); of pairs (low, high), one per input, too. None: no rows."""
    rows = numbers([] if limits is None else limits, "limits")
    if not rows.size:
        return np.zeros((0, 3))
    if rows.shape == (m, 2):
        return np.column_stack([np.arange(m), rows])
    if rows.ndim != 2 or rows.shape[1] != 3 or not np.isin(rows[:, 0], range(m)).all():
        raise DataError(
            f"limits should be rows (input, low, high), or one pair (low, high) for each of {m} "
            f"inputs; they are {rows.tolist()}"
        )
    return rows


def valid_rows(limits: FloatArray, n: int) -> FloatArray:
    """Rows (input, low, high) as rows of `VectorField.valid` for n states."""
    return np.column_stack([n + limits[:, 0], limits[:, 1:]])


def _dynamics(
    problem: ContinuousTracking, held: Hold | None, limits: FloatArray
) -> tuple[VectorField, Expansion | None]:
    """The field; or, where it is no polynomial of a degree that fits, its linearisation.

    limits: rows (input, low, high) within which both say they are valid.

    A hold needs fields that are affine in each input, and cubics at most. Without a given policy
    the motion gets more knots where they are too far apart to expand anything.
    """
    dynamics, nominal, uncertain = problem.dynamics, problem.nominal, problem.uncertain
    sizes = nominal.x.control.shape[2], nominal.u.control.shape[2]
    valid = valid_rows(limits, sizes[0])
    if isinstance(dynamics, VectorField):
        if uncertain is not None:
            raise DataError("a vector field states its own bounds of w: leave out `uncertain`")
        return dynamics.within(valid), None
    try:
        field = VectorField.from_function(dynamics, *sizes, uncertain=uncertain)
        if field.degree <= DEGREE and (held is None or not field.squares_inputs):
            return field.within(valid), None
    except NotPolynomial:
        pass
    rates = Rates.of(dynamics, *sizes, uncertain, affine=held is not None)
    rates = replace(rates, valid=valid)
    expansion = Expansion(rates, nominal).refined(
        MOST_KNOTS if problem.policy is None else len(nominal.t)
    )
    return expansion.linear(), expansion


def refuse_nominal(field: VectorField | Rates, nominal: Nominal) -> None:
    """Raise unless the nominal fits the dynamics' sizes and obeys them well enough."""
    sizes = (nominal.x.control.shape[2], nominal.u.control.shape[2])
    if sizes != (field.n, field.m):
        raise DataError(
            f"the nominal has {sizes[0]} states and {sizes[1]} inputs, the dynamics {field.n} and "
            f"{field.m}"
        )
    gap, t, state = nominal.defect(field)
    if gap > largest_defect(nominal):
        scale = float(np.abs(nominal.x.derivative().control).max())
        raise DataError(
            f"the nominal does not obey the dynamics: dx{state}/dt is off by {gap:.3g} at "
            f"t = {t:.6g} s (the largest rate is {scale:.3g}); use integrate_nominal "
            "or more knots"
        )


def largest_defect(nominal: Nominal) -> float:
    """How far ẋ₀ may miss the dynamics."""
    rate = float(np.abs(nominal.x.derivative().control).max())
    size = float(np.abs(nominal.x.control).max()) / float(np.ptp(nominal.t))
    return DEFECT * max(rate, AT_REST * max(size, 1.0))


def refuse_saturated(nominal: Nominal, limits: FloatArray) -> None:
    """Raise DataError unless the nominal's own inputs are within the limits (L, 3)."""
    for i, low, high in limits.tolist():
        u = nominal.u.control[:, :, int(i)]
        least, most = float(np.min(u)), float(np.max(u))
        if not (low < least and most < high):
            raise DataError(
                f"the nominal's input {int(i)} needs [{least:.6g}, {most:.6g}], its limits are "
                f"[{low:g}, {high:g}]: no room is left to correct anything. Plan it within the "
                "limits (`limits` of plan_motion), or in more seconds"
            )


def _wanted_goal(goal: Goal | ArrayLike, nominal: Nominal, n: int) -> Goal:
    if isinstance(goal, Goal):
        wanted = goal
    else:
        P = numbers(goal, "the goal")
        if P.shape == (n,):
            if not (np.isfinite(P).all() and (P > 0).all()):
                raise DataError(f"the goal's half-widths should be positive numbers, are {P}")
            P = np.diag(P**-2.0)
        wanted = Goal(nominal.x.ends()[-1], P)
    if wanted.P.shape != (n, n) or wanted.centre.shape != (n,):
        raise DataError(
            f"the goal should be {n} half-widths, or an ellipsoid's ({n}, {n}) matrix; its "
            f"shape is {wanted.P.shape}"
        )
    P = np.tril(wanted.P) + np.tril(wanted.P, -1).T  # the other triangle differs by rounding
    skew = np.abs(wanted.P - P).max(initial=0.0) / 2
    if not skew <= ASYMMETRY * np.abs(P).max() or np.linalg.eigvalsh(P)[0] <= 0:
        raise DataError("the goal's matrix should be symmetric positive definite")
    d = nominal.x.ends()[-1] - wanted.centre
    if d @ P @ d >= 1:
        raise DataError(f"the nominal ends outside the goal: |x - centre|² = {d @ P @ d:.3g} > 1")
    return Goal(wanted.centre, P)


def own_motion(policy: ContinuousPolicy, nominal: Nominal) -> Nominal:
    """The motion of a policy, with its knots; DataError unless it is the nominal."""
    own, t = Nominal(policy.x, policy.u), nominal.t
    same = own.x.control.shape[2] == nominal.x.control.shape[2]
    same = same and np.array_equal(own.t[[0, -1]], t[[0, -1]])
    if not same or not np.allclose(own.x(t), nominal.x(t), SAME_MOTION, SAME_MOTION):
        raise DataError("the policy is around another nominal")
    return own


def final_level(
    policy: ContinuousPolicy,
    S: FloatArray,
    goal: Goal,
    expansion: Expansion | None,
) -> float:
    """ρ(t_f): the largest level inside the goal, and small enough to be expanded."""
    end = policy.x.ends()[-1]
    low, high = 0.0, 1.0
    d, rho = end - goal.centre, 1.0
    if d.any():
        for _ in range(40):
            middle = (low + high) / 2
            found = ellipsoid_inside(end, S[-1] / middle, goal.centre, goal.P)
            low, high = (low, middle) if found is None else (middle, high)
        rho = low * (1 - 1e-6)
    if expansion is not None:
        rho *= expansion.room(policy, S, len(S) - 2, rho)
    return rho
