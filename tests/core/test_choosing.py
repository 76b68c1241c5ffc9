"""The rule that chooses: what is held out, what is taken, and what is promised."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.signal import lfilter

from nlsid_core.arrays import FloatArray
from nlsid_core.data.trajectory import Dataset, Trajectory
from nlsid_core.errors import DataError, Infeasible
from nlsid_core.identification import (
    Attempt,
    Choice,
    Degrees,
    FilterMapFilter,
    LeastSquares,
    Network,
    Polynomial,
    Row,
    Rse,
    Search,
    Sem,
    choosing,
    identify,
    simulation_percent,
)
from nlsid_core.identification.choosing import HeldOut, fitted, simplest
from nlsid_core.identification.prediction import simulate_started, simulate_trial
from nlsid_core.running.stepping import Stepper

POLES = (0.97, 0.9)  # forget slowly: the noise of a raw start stays


def trial(seed: int, *, samples: int = 400, size: float = 1.0, bend: float = 0.0) -> Trajectory:
    """Two filters behind each other, with noise, and a gain that falls with the amplitude."""
    rng = np.random.default_rng(seed)
    u = size * np.repeat(rng.standard_normal(samples // 4), 4)
    y = clean(u - bend * u**3) + 0.05 * rng.standard_normal(samples)
    return Trajectory(t=0.1 * np.arange(samples), y=y, u=u, name=f"{seed} {size:g}")


def clean(u: FloatArray) -> FloatArray:
    return np.asarray(lfilter([0.0, 0.1], np.poly(POLES), u))


def judged(data: Dataset, attempts: list[Attempt]) -> Choice:
    held_out = HeldOut.of(data)
    return Choice(held_out, tuple(held_out.judged(held_out.glance(one)) for one in attempts))


LAGS = [Attempt(Polynomial(lags), LeastSquares()) for lags in (1, 2, 6)]


def test_one_recording_is_cut_in_time() -> None:
    choice = judged(Dataset((trial(0, samples=1200),)), [*LAGS, Attempt(Polynomial(2), Rse(6))])
    assert choice.held_out.on == "stretches of the only excitation"
    for fold in choice.held_out.folds:
        together = sum(map(len, fold.fitted)) + sum(len(t) for group in fold.judged for t in group)
        assert together == 1200, "each sample is fitted or judged"
    assert all(choice.best.percent <= 1.01 * row.percent for row in choice.rows)


@pytest.mark.parametrize(
    ("worse", "taken"),
    [
        ((1.0, 1.04, 1.0, 1.0, 1.02, 0.98), "small"),
        ((1.01,) * 6, "small"),
        ((1.04,) * 6, "large"),  # a little
        ((1.0, 1.0, 1.0, 1.0, 1.0, 4.0), "large"),  # on one stretch, but much
    ],
)
def test_the_simplest_that_is_as_good_as_the_best_is_taken(
    worse: tuple[float, ...], taken: str
) -> None:
    best = np.array([1.0, 2.0, 1.5, 3.0, 1.0, 2.0])
    data = Dataset((trial(0, samples=1200),))
    large, small = (
        Row(one, errors, (fitted(data, one, data),))
        for one, errors in ((LAGS[2], best), (LAGS[0], best * worse))
    )
    assert simplest([large, small], np.ones(6, bool)) is {"small": small, "large": large}[taken]


def test_repeats_of_an_excitation_stay_together_and_others_make_the_promise() -> None:
    """A linear model of a gain that falls: other amplitudes are what it is worst at."""
    runs = [
        replace(trial(9, size=size, bend=0.1), name=f"{size} {k}")
        for size in (0.4, 0.8, 1.2)
        for k in range(3)
    ]
    choice = judged(Dataset(tuple(runs)), [Attempt(Polynomial(2), Rse(6))])
    assert choice.held_out.on == "excitations"
    for fold in choice.held_out.folds:
        held = {t.name.split("[")[0] for group in fold.judged for t in group}
        assert len({name.split()[0] for name in held}) == 1, "one excitation, whole"
        assert not held & set(fold.fitted.names)
    mixed = identify(Dataset(tuple(runs[::2])), Polynomial(2), search=Search(comparators=()))
    assert choice.promise.percent > 1.5 * mixed.chosen.error_percent(Dataset(tuple(runs[1::2])))


def test_no_fold_has_all_excitations_that_vary_most() -> None:
    """Recordings that come in turn, such as a start from rest and two drives, would be one fold.

    All is judged on the first one, so its excitations are the largest.
    """
    held_out = HeldOut.of(Dataset(tuple(trial(k, size=0.1 if k % 3 else 1.0) for k in range(9))))
    largest = [float(np.var(fold.judged[0][0].u)) for fold in held_out.folds]
    assert largest == sorted(largest, reverse=True)
    for fold in held_out.folds:
        assert sum(group[0].name.split("[")[0].endswith(" 1") for group in fold.judged) == 1


def test_models_that_differ_where_inputs_are_larger_count_as_apart(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """A cubic of the inputs follows from the data; above the largest input it does not."""
    choice = judged(
        Dataset(tuple(trial(k, bend=0.1) for k in range(6))),
        [Attempt(Polynomial(2, (1,), Degrees(inputs=3)), Rse(2))],
    )
    monkeypatch.setattr(choosing, "BEYOND", ((1, 1.0),))
    recorded = choice.held_out.apart([fit.model for fit in choice.best.fits])
    assert choice.best.apart > 1.1 * recorded


def test_the_promise_has_no_lower_end_where_the_model_is_fitted_to_more() -> None:
    choice = judged(Dataset((trial(0, samples=18_000),)), [Attempt(Polynomial(2), Rse(2))])
    assert str(choice.promise).startswith("at most")


def test_what_is_promised_holds_on_new_excitations() -> None:
    choice = judged(Dataset(tuple(trial(k) for k in range(9))), LAGS)
    model = fitted(choice.held_out.data, choice.best.attempt, choice.held_out.data).model
    errors = [choice.held_out.error(model, [trial(k)]) for k in range(20, 30)]
    assert 0.0 < choice.promise.low < 100.0 * float(np.sqrt(np.mean(errors))) < choice.promise.high


@pytest.mark.parametrize(
    ("model_class", "method"),
    [
        (Polynomial(2), Rse(4)),
        (Polynomial(2, (1, 2)), Rse(4)),
        (Polynomial(2, set="3.8"), Sem(4)),
        pytest.param(
            Network(FilterMapFilter((1, 1), intervals=4, starts=2)),
            Sem(4, certified=True),
            marks=pytest.mark.slow,
        ),
    ],
)
def test_a_simulation_starts_where_the_first_samples_are_nearest(
    model_class: Polynomial, method: Rse
) -> None:
    """The same state in scoring and in what runs; the noise of raw starts would be carried on."""
    chosen = identify(
        Dataset(tuple(trial(k) for k in range(4))),
        model_class,
        method=method,
        search=Search(comparators=()),
    ).chosen
    model, raw, started = chosen.model, 0.0, 0.0
    for first in range(100, 180, 8):
        part = trial(7).rows(slice(first, None))
        truth = clean(trial(7).u[:, 0])[first:, None]
        [found] = simulate_started(model, [part], 40)
        stepper = Stepper(model)
        x = stepper.begin(part.y[:40], part.u[:40])
        np.testing.assert_allclose(stepper.advance(x[None], part.u[40])[0][0], found[40], atol=1e-9)
        raw += float(np.sum((simulate_trial(model, part) - truth)[40:90] ** 2))
        started += float(np.sum((found - truth)[40:90] ** 2))
    assert started < 0.8 * raw
    short = Dataset(tuple(trial(7).rows(slice(n, n + 100)) for n in range(100, 180, 8)))
    assert chosen.error_percent(short) < 0.97 * simulation_percent(model, short)


def test_what_has_no_model_says_why_and_too_little_data_are_refused() -> None:
    choice = judged(Dataset((trial(0),)), [Attempt(Polynomial(60), LeastSquares())])
    assert "equations for" in choice.rows[0].refusal
    with pytest.raises(Infeasible):
        _ = choice.best
    with pytest.raises(DataError, match="too few"):
        HeldOut.of(Dataset((trial(0, samples=80),)))
