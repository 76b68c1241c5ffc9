"""`design_output_tube`: a proved tube around the simulation of a stable model, or around a plan.

    E ζ = 0,   x̄⁺ = F ζ + L e,   o = H ζ + e,   E_{k+1} = ρ E_k + e_k'R e_k
The kernel's reading of the model file gives F, H and the vertices E. Observers L are Kalman gains
of the mean increment over a grid of noise ratios, ρ is taken from a grid above the square of the
proved rate. Of all pairs those whose forecast a reaction time ahead is the narrowest are solved as
semidefinite programs, on the training trials; the level is measured on other trials.
Source: docs/certificate_tube.md.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from fractions import Fraction
from itertools import product
from typing import Any, TypeAlias

import numpy as np
from scipy.linalg import LinAlgError
from scipy.signal import lfilter

from nlsid_core import files
from nlsid_core.arrays import FloatArray, Json
from nlsid_core.data.calibration import calibration_trials
from nlsid_core.data.trajectory import Dataset, Trajectory
from nlsid_core.design.increment_form import Form, read_form
from nlsid_core.design.levels import followed
from nlsid_core.design.plan import lqr_gain, track_profile
from nlsid_core.design.problems import OutputTube
from nlsid_core.design.riccati import solve_riccati
from nlsid_core.design.tube_program import TAU_ROOM, Found, Pair, gramian, slowed, solved
from nlsid_core.designs import Design
from nlsid_core.errors import CertificateRejected, DataError, Infeasible
from nlsid_core.funnels.factor import refuse_unmonitorable
from nlsid_core.funnels.tube import Cusum, Measured, Peak, Tube, TubeFunnel
from nlsid_core.kernel import Rejected
from nlsid_core.models import BlockCascade, DifferenceEquation, ImplicitModel, StableModel
from nlsid_core.policies.tube import TubePolicy
from nlsid_core.running.detectors import DRIFT, cusum
from nlsid_core.running.stepping import Stepper
from nlsid_core.running.tubes import refuse_far

NOISE_RATIOS = np.logspace(-4, 4, 17)  # process over measurement noise, of a Kalman gain
SOLVED = 6  # pairs (L, ρ) whose program is solved, best forecasts first
CLOSE = 1.25  # times the narrowest forecast: of these the tube that is narrowest for ever is taken
MOST = 36  # pairs that are tried where the first are infeasible or refused
REACTION = 10  # samples: the reaction time if none is named
LEAST_WINDOW = 10  # times settling and reaction: a window of a single recording
SHORTEST_WINDOW = 2  # of a recording that is too short for two of these
SETTLED = 1e-3  # part of a cascade's first filter that is left of its start at sample 0
LONGEST_SETTLING = 0.25  # of the shortest trial
SLOWER = (1.0, 0.3, 0.1, 0.03, 0.01, 3e-3, 1e-3, 3e-4, 1e-4)  # parts of L that are tried
NEAR = 1.1  # times the response: a tube that is as narrow is narrow enough
TINY = float(np.finfo(float).tiny)
# Room at first, and growth, of what one number scales: a headline's peaks, which are most of its
# width; other peaks and energies; those of a tube that follows the commands, whose width varies
# less from trial to trial; and CUSUM's sums, which vary most. Chosen on eight recordings
# (docs/decisions/0071); what is promised of a next trial is the same for any numbers.
PEAK, BESIDE, FOLLOWING, SUMS = (1.0, 1.0), (1.2, 1.25), (1.2, 0.5), (2.0, 6.0)
BOX_ROOM = 0.1  # of a signal's range, on both sides of it

OutputTubeDesign: TypeAlias = Design[Any, Any, TubeFunnel, None]


def design_output_tube(problem: OutputTube) -> OutputTubeDesign:
    """The funnel that the problem describes.

    Raises DataError on options or trials that do not fit, Infeasible if no tube is found or proved.
    """
    model, train, horizon, level = problem.model, problem.train, problem.horizon, problem.level
    profile, inlet = problem.profile, problem.inlet
    safety_factor = problem.safety_factor if problem.false_alarms is None else 1.0
    stepper = Stepper(model)
    settling = _settling(model, stepper, train)
    trials = calibration_trials(
        train, problem.calibration, least=least_window(model, train, horizon)
    )
    train, rank = trials.design, _rank(problem.false_alarms, len(trials.calibration))
    y_box, u_box = _box(model, stepper, train, problem.box)
    bounds = None if y_box is None else {"y": y_box.tolist(), "u": u_box.tolist()}  # type: ignore[union-attr]
    K: FloatArray | None = None
    if profile is not None:
        K, level = _gain(model, problem.lqr_weights), "constant"
    form = Form.of(model, bounds, K)
    samples = max(1, round((problem.reaction_time or REACTION * model.period) / model.period))
    amplitudes = np.maximum(
        np.ptp(np.concatenate([trial.y for trial in train]), axis=0) / 2.0, TINY
    )
    gains = _gains(form, amplitudes)
    e = [innovations(model, gains, trial, settling) for trial in train]

    def tube_of(design: Found, samples: int | None, peak: Peak | None = None) -> Tube:
        return Tube(
            rho=design.rho,
            L=design.L,
            P=design.P,
            R=design.R,
            tau=design.tau,
            half_widths=np.ones(len(design.tau)),
            level=1.0,
            measured=Measured(0.0, safety_factor, trials.designed_on, trials.measured_on, rank),
            samples=samples,
            inlet=inlet**2 / float(np.linalg.inv(design.P)[0, 0]) if inlet else 0.0,
            peak=peak,
        )

    def proved(funnel: TubeFunnel, found: Sequence[Found]) -> OutputTubeDesign:
        policy = None
        if profile is not None and K is not None:
            assert isinstance(model, DifferenceEquation)
            duration = profile[-1][0] if horizon is None else horizon
            at_rest, planned = track_profile(model, profile, round(duration / model.period))
            policy = TubePolicy(
                at_rest, planned, K=K, L=found[0].L[:, 0], period=model.period, model=funnel.model
            )
            funnel = replace(funnel, policy=files.digest(policy.document()))
            refuse_unmonitorable(funnel)
        trees = [design.multipliers for design in found]
        proof: Json = {} if trees[0] is None else {"multipliers": trees}
        return Design.proved(model, policy, funnel, claim={"kind": "tube"}, proof=proof, found=None)

    def around(*tubes: Tube) -> TubeFunnel:
        return TubeFunnel(tubes, settling, files.digest(model.document()), y_box, u_box)

    def decided(design: Found, peak: Peak | None = None) -> str:
        """Why the kernel refuses the candidate, whatever its level; empty if it is proved."""
        try:
            tube = tube_of(design, 1 if design.rho == 1.0 else None, peak)
            proved(around(replace(tube, half_widths=_widths(tube) / 0.99)), [design])
        except CertificateRejected as refusal:
            return str(refusal)
        return ""

    start = inlet / safety_factor
    fast = _best(form, _pairs(gains, e, form.fading()), amplitudes, samples, decided, start)
    slower = np.multiply.outer([*SLOWER, 0.0], fast.L)
    own = [innovations(model, slower, trial, settling) for trial in train]
    found, tubes, alarm, trained = [fast], [tube_of(fast, None)], None, None
    if horizon is not None:
        length = max(1, round(horizon / model.period))
        longest = max(map(len, trials.calibration)) - settling
        if length > longest:
            raise DataError(
                f"horizon {horizon} s is {length} samples; the energy can be measured on the "
                f"calibration trials for 1 to {longest}"
            )
        if profile is not None:  # the policy has one observer
            gains, e = fast.L[None], [part[:, :1] for part in own]
        found.append(_best(form, _pairs(gains, e, [1.0]), amplitudes, length, decided, start))
        tubes.append(tube_of(found[1], length))
    if profile is None:  # what is assumed around a plan is what is held there
        headline, peak = _headline(form, fast, own, amplitudes, decided)
        follows = None
        if level != "constant":
            spent = [energy(part[:, 0], fast) for part in own]
            follows = followed(spent, [trial.u for trial in train], always=level == "commands")
        if follows is None and np.array_equal(headline.L, fast.L):
            found[0], tubes[0] = headline, tube_of(headline, None, peak)
        else:
            early = replace(peak, direct=np.zeros_like(peak.direct))
            tubes[0] = replace(tubes[0], follows=follows, peak=early)
            found.append(headline)
            tubes.append(tube_of(headline, None, peak))
        deviation = np.concatenate([part[:, 0] for part in own]).std(axis=0)
        alarm = Cusum(np.maximum(deviation, TINY), DRIFT, DRIFT)
        trained = commanded([*train, *trials.calibration])
    funnel = replace(around(*tubes), cusum=alarm, commands=trained)
    funnel = calibrated(funnel, model, train, trials.calibration)
    refuse_far(model, funnel, trials.calibration)
    return proved(funnel, found)


def _rank(false_alarms: float | None, trials: int) -> int:
    """How many of so many trials and one more may exceed their levels, the one more included."""
    if false_alarms is None:
        return 1
    rank = math.floor(false_alarms * (trials + 1) * (1.0 + 1e-12))
    if not 1 <= rank <= trials:
        raise DataError(
            f"false alarms in {false_alarms:g} of the trials: {trials} calibration trials can "
            f"promise 1/{trials + 1} to {trials}/{trials + 1}; record more for less"
        )
    return rank


def statistics(funnel: TubeFunnel, model: StableModel, trial: Trajectory) -> FloatArray:
    """(S, 3) the most along a trial of all that alarms: of each tube √E and its peaks, then CUSUM.

    Each with its room at first and its growth. Of the funnel's rules, whatever its levels are.
    """
    settling, alarm = funnel.settling, funnel.cusum
    e = innovations(model, np.stack([tube.L for tube in funnel.tubes]), trial, settling)
    found: list[tuple[float, float, float]] = []
    for j, tube in enumerate(funnel.tubes):
        g: FloatArray = np.ones(len(e))
        if tube.follows is not None:
            g = tube.follows.along(trial.u)[settling:]
        beside = BESIDE if tube.follows is None else FOLLOWING
        found.append((math.sqrt((energy(e[:, j], tube) / g)[: tube.samples].max()), *beside))
        if tube.peak is not None:
            peaks = (np.abs(e[:, j]) / np.sqrt(np.maximum(g, 1.0))[:, None]).max(axis=0)
            rule = PEAK if tube is funnel.tubes[-1] else beside
            found += [(peak, *rule) for peak in peaks.tolist()]
    if alarm is not None:
        z = funnel.tubes[0].measured.safety_factor * e[:, 0] / alarm.deviation
        found.append((max(DRIFT, float(cusum(z).max())), *SUMS))
    return np.asarray(np.maximum(found, TINY))


def commanded(trials: Sequence[Trajectory]) -> FloatArray:
    """(n_u, 3) the least and the largest of every input, and its largest change in a sample."""
    u = np.concatenate([trial.u for trial in trials])
    changes = np.concatenate([np.abs(np.diff(trial.u, axis=0)) for trial in trials])
    return np.column_stack([u.min(axis=0), u.max(axis=0), changes.max(axis=0)])


def calibrated(
    funnel: TubeFunnel, model: StableModel, design: Dataset, calibration: Dataset
) -> TubeFunnel:
    """The funnel with all its levels, which one number scales: level_s = at_first_s scale^growth_s.

    The design's trials fix at_first and growth. Scale is the least at which a calibration trial
    keeps all levels, and of these the largest, or that of the tube's rank. So a next trial exceeds
    any of the levels with the probability of one number: rank/(m + 1) at most.
    Source: docs/theory.md, "One scale".
    """
    before, seen = (
        np.array([statistics(funnel, model, trial) for trial in part])
        for part in (design, calibration)
    )
    room, growth = before[0, :, 1:].T
    at_first = before[:, :, 0].max(axis=0) * room
    scales = np.sort((np.log(seen[:, :, 0] / at_first) / growth).max(axis=1))[::-1]
    levels = at_first * np.exp(growth * scales[funnel.tubes[0].measured.rank - 1])
    tubes, used = [], 0
    for tube in funnel.tubes:
        end = used + (1 if tube.peak is None else 1 + len(tube.R))
        tubes.append(_scaled(tube, float(levels[used]) ** 2, levels[used + 1 : end]))
        used = end
    if funnel.cusum is not None:
        alarm = replace(funnel.cusum, threshold=_above(float(levels[-1])))
        funnel = replace(funnel, cusum=alarm)
    return replace(funnel, tubes=tuple(tubes))


def _scaled(tube: Tube, E: float, peaks: FloatArray) -> Tube:
    """With level, peaks and half-widths, where E and the peaks are those at factor 1."""
    given, peak = tube.measured, tube.peak
    most = _above(E)
    level = _above(given.safety_factor**2 * most)
    if peak is not None:
        seen = np.array([_above(float(each)) for each in peaks])
        at_most = np.array([_above(given.safety_factor * float(each)) for each in seen])
        peak = replace(peak, at_most=at_most, measured=seen)
    tube = replace(tube, measured=replace(given, largest=most), level=level, peak=peak)
    return replace(tube, half_widths=np.array([_rounded_up(float(w)) for w in _widths(tube)]))


def _widths(tube: Tube) -> FloatArray:
    """(p,) what level and peaks leave of the outputs."""
    widths = np.sqrt((tube.level + tube.rho * tube.inlet) / tube.tau)
    return np.asarray(
        widths if tube.peak is None else widths + tube.peak.direct * tube.peak.at_most
    )


def _headline(
    form: Form,
    fast: Found,
    slow: Sequence[FloatArray],
    amplitudes: FloatArray,
    decided: Callable[[Found, Peak], str],
) -> tuple[Found, Peak]:
    """The fastest observer whose tube is about as narrow as the response; else the narrowest.

    slow: innovations (N, B, p) of SLOWER, and of none, in each trial of the design. Of an
    innovation the part c is bounded by its peak ε, where √(ℓ (a + (1 - c)² r)) + c ε is least: ℓ
    the energy, a and r the output's shares of it by V and by e.
    """
    sizes = [
        np.max([np.abs(part[:, i]).max(axis=0) for part in slow], axis=0)
        for i in range(len(SLOWER) + 1)
    ]
    r = np.diag(np.linalg.inv(fast.R)) * (1.0 + TAU_ROOM)
    tried: list[tuple[float, Found, Peak]] = []
    # R of several outputs was fitted to the innovations at s = 1, which are the smaller for it.
    for i, s in list(enumerate(SLOWER))[len(amplitudes) > 1 :]:
        found, peak = slowed(form, fast, s), np.maximum(sizes[i], TINY)
        level = max(float(energy(part[:, i], fast).max()) for part in slow)
        room = found.tau * r * np.maximum(level * r - peak**2, TINY)
        rest = np.minimum(1.0, peak / np.sqrt(room))
        share = 1.0 / found.tau + rest**2 * r
        width = np.sqrt(level * share) + (1.0 - rest) * peak
        tried.append(
            (
                float(np.sum(width / amplitudes)),
                replace(found, tau=1.0 / share),
                Peak(peak, peak, 1.0 - rest),
            )
        )
    enough = NEAR * float(np.sum(sizes[-1] / amplitudes))
    for _, found, peak in sorted(tried, key=lambda entry: max(entry[0], enough)):
        if not decided(found, peak):
            return found, peak
    peak = np.maximum(sizes[0], TINY)
    return fast, Peak(peak, peak, np.zeros_like(peak))


def _gain(model: StableModel, weights: tuple[float, float] | None) -> FloatArray:
    """K (n,) of the policy that tracks a plan; zeros without weights."""
    if not isinstance(model, DifferenceEquation):
        raise DataError(
            f"a profile is planned for a linear model, not for a {type(model).__name__}; leave it "
            "out for a tube around the model's simulation"
        )
    if weights is None:
        return np.zeros(len(model))
    return lqr_gain(model, output_weight=weights[0], input_weight=weights[1])


def least_window(model: StableModel, train: Dataset, horizon: float | None = None) -> int:
    """Samples of a window of a single recording, on which a tube is designed or measured.

    horizon: s, if an energy has to last so long on it.
    """
    settling = _settling(model, Stepper(model), train)
    if horizon is not None:
        return settling + max(1, round(horizon / model.period))
    start, half = settling + REACTION, max(map(len, train)) // 2
    return max(SHORTEST_WINDOW * start, min(LEAST_WINDOW * start, half))


def energy(e: FloatArray, tube: Tube | Found) -> FloatArray:
    """E_1 … E_N of innovations e (N, p)."""
    spent = np.einsum("ti,ij,tj->t", e, tube.R, e)
    return np.asarray(lfilter([1.0], [1.0, -tube.rho], spent))


def innovations(
    model: StableModel, gains: FloatArray, trial: Trajectory, settling: int
) -> FloatArray:
    """e(t), t = settling …, of observers with gains (B, n, p): (N - settling, B, p)."""
    stepper = Stepper(model)
    if len(trial) <= settling:
        raise DataError(f"{trial.name}: {len(trial)} samples; the first {settling} start a run")
    start = stepper.begin(trial.y[:settling], trial.u[:settling])
    x = np.tile(start, (len(gains), 1))
    e = np.empty((len(trial) - settling, len(gains), len(stepper.y)))
    for k, (y, u) in enumerate(zip(trial.y[settling:], trial.u[settling:], strict=True)):
        predicted, x = stepper.advance(x, u)
        e[k] = y - predicted
        x = x + np.einsum("bnp,bp->bn", gains, e[k])
    return e


def _settling(model: StableModel, stepper: Stepper, dataset: Dataset) -> int:
    """Samples before sample 0: the model's lags, and a cascade's first filter has to settle."""
    least = max(stepper.lags, 1)
    if not isinstance(model, BlockCascade) or not len(model.a1):
        return least
    radius = float(np.abs(model.poles[0]).max(initial=0.0))
    wanted = int(np.ceil(np.log(SETTLED) / np.log(radius))) if 0.0 < radius < 1.0 else least
    return max(least, min(wanted, int(LONGEST_SETTLING * min(map(len, dataset)))))


def _box(
    model: StableModel,
    stepper: Stepper,
    dataset: Dataset,
    box: Sequence[tuple[float, float]] | None,
) -> tuple[FloatArray | None, FloatArray | None]:
    """(p, 2) and (n_u, 2) ranges, of a model whose increments are known on a box only."""
    try:
        read_form(model, None)
    except Rejected:
        if not isinstance(model, ImplicitModel):
            raise
        p = len(stepper.y)
        if box is not None:
            return np.array(box[:p], dtype=np.float64), np.array(box[p:], dtype=np.float64)
        ranges = []
        for key in ("y", "u"):
            values = np.concatenate([getattr(trial, key) for trial in dataset])
            low, high = values.min(axis=0), values.max(axis=0)
            room = BOX_ROOM * (high - low) + np.finfo(float).tiny
            ranges.append(np.column_stack([low - room, high + room]))
        return ranges[0], ranges[1]
    return None, None


def _gains(form: Form, amplitudes: FloatArray) -> FloatArray:
    """(B, n, p) Kalman gains of x̄⁺ = A x̄ + G d, o = C x̄ + D d + noise.

    d is what enters with ν (a linear model: with the input, or with the output's equation).
    Source: Anderson and Moore, Optimal Filtering, section 5.4: correlated noises.
    """
    p, m = len(form.H), form.m
    sizes: FloatArray = np.diag(amplitudes**2)
    if m == 0:
        assert form.inputs is not None
        noises: list[tuple[FloatArray, FloatArray, FloatArray]] = [
            (form.A[:, :1], np.eye(1), sizes),
            (*form.inputs, np.eye(1)),
        ]
    else:
        G, D = form.F[:, :m], form.H[:, :m]
        spread: FloatArray = np.eye(m) * float(np.mean(amplitudes)) ** 2
        if m == p and np.linalg.matrix_rank(D) == p:
            inverse = np.linalg.inv(D)
            spread = inverse @ sizes @ inverse.T
        noises = [(G, D, spread)]
    found = []
    for (G, D, spread), ratio in product(noises, NOISE_RATIOS):
        Q, S = ratio * G @ spread @ G.T, ratio * G @ spread @ D.T
        R = ratio * D @ spread @ D.T + sizes
        try:
            X = solve_riccati(form.A.T, form.C.T, Q, R, S)
        except Infeasible:
            continue
        L = np.linalg.solve(form.C @ X @ form.C.T + R, (form.A @ X @ form.C.T + S).T).T
        if np.isfinite(L).all():
            found.append(L)
    if not found:
        raise Infeasible("no observer: the Riccati equation of the mean increment has no solution")
    return np.array(found)


def _pairs(gains: FloatArray, e: list[FloatArray], rhos: Sequence[float]) -> list[Pair]:
    """Every gain with every ρ; e: innovations (N, B, p) of the gains in each trial."""
    return [
        Pair(gains[i], rho, [part[:, i] for part in e])
        for i, rho in product(range(len(gains)), rhos)
    ]


def _best(
    form: Form,
    pairs: Sequence[Pair],
    amplitudes: FloatArray,
    samples: int,
    decided: Callable[[Found], str],
    start: float,
) -> Found:
    """The pair (L, ρ), solved and proved, of the narrowest tube with a forecast near the narrowest.

    start: the first output's error there, in the unit in which the innovations are not scaled up.
    Pairs are tried in the order of what the
    mean increment alone would give: W = A W A'/ρ + L R⁻¹L', width² = α (R⁻¹_jj + C_j W C_j'/ρ), α
    the most that E can be, `samples` after 0 or ever. SOLVED are solved; while the kernel refuses
    all of them (`decided` says why), as many more. An energy's tube has its forecast's length.
    """
    near = CLOSE if min(pair.rho for pair in pairs) < 1.0 else 1.0

    def widths(
        pair: Pair, R: FloatArray, variance: FloatArray, W: FloatArray
    ) -> tuple[float, float]:
        """A forecast's and the lasting tube's, per amplitude."""
        rho = pair.rho
        began = rho * start**2 / float(W[0, 0]) if start else 0.0
        spent = [np.einsum("ti,ij,tj->t", part, R, part) for part in pair.e]
        fading = rho ** np.arange(samples + 1)
        ahead = max(float(np.convolve(part, fading).max()) for part in spent)
        ever = max(float(lfilter([1.0], [1.0, -rho], part).max()) for part in spent)
        scale = float(np.mean(np.sqrt(variance) / amplitudes))
        return scale * float(np.sqrt(ahead + began)), scale * float(np.sqrt(ever + began))

    def ordered(found: list[tuple[float, float, Any]]) -> list[Any]:
        """Sort by the lasting width where the forecast is near the narrowest, else by forecast."""
        enough = near * min((ahead for ahead, _, _ in found), default=0.0)
        keys = [(0.0, ever) if ahead <= enough else (ahead, 0.0) for ahead, ever, _ in found]
        return [found[k][2] for k in sorted(range(len(found)), key=keys.__getitem__)]

    ranked = []
    for pair in pairs:
        try:
            W, R = gramian(form, pair)
        except (LinAlgError, ValueError):
            continue
        reach = np.einsum("ij,jk,ik->i", form.C, W, form.C) / pair.rho
        variance = np.diag(np.linalg.inv(R)) + reach
        if np.isfinite(variance).all() and (variance > 0.0).all():
            ranked.append((*widths(pair, R, variance, W), pair))
    sorted_pairs, refused = ordered(ranked), ""
    for first in range(0, min(len(sorted_pairs), MOST), SOLVED):
        tried: list[tuple[float, float, Any]] = []
        for pair in sorted_pairs[first : first + SOLVED]:
            found = solved(form, pair, amplitudes)
            if found is not None:
                W = np.linalg.inv(found.P)
                tried.append((*widths(pair, found.R, 1.0 / found.tau, W), found))
        for candidate in ordered(tried):
            refused = decided(candidate)
            if not refused:
                return candidate  # type: ignore[no-any-return]
    if len(form.modes) > 1:
        raise Infeasible(
            "no proved tube serves both the played inputs and the policy; try a larger input weight"
        )
    if refused:
        raise Infeasible(
            "the solver's tubes are too inaccurate for the exact decision; try another "
            f"reaction_time, or a model with fewer lags. The last one: {refused}"
        )
    raise Infeasible(
        "no storage function bounds the output by the innovations: the increments are too "
        "different over the model's range; give a smaller range of inputs or a smaller box"
    )


def _rounded_up(width: float) -> float:
    """The next number of three significant digits, or the float64 just below that decimal number.

    Then the decimal number is a bound, and the kernel prints it as it is.
    """
    digits = 2 - int(np.floor(np.log10(width)))
    rounded = float(np.round(np.ceil(width * (1.0 + 1e-12) * 10.0**digits) / 10.0**digits, digits))
    above = Fraction(rounded) > Fraction(repr(rounded))
    return float(np.nextafter(rounded, 0.0)) if above else rounded


def _above(value: float) -> float:
    """A float64 above the real number that `value` was rounded from."""
    return float(np.nextafter(value * (1.0 + 1e-12), np.inf))
