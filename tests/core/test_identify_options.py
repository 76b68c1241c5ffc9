"""Options of families and methods: each refusal names the option, its value and what is allowed."""

import pickle
from dataclasses import FrozenInstanceError, fields
from typing import Any

import pytest

from nlsid_core.errors import DataError, OptionError
from nlsid_core.identification import (
    METHODS,
    CellRow,
    Degrees,
    Feedback,
    FilterMapFilter,
    LeastSquares,
    Network,
    Polynomial,
    Rie,
    Rse,
    Sem,
    methods_of,
)

NEEDED: dict[type, dict[str, Any]] = {Network: {"structure": Feedback()}, Polynomial: {"lags": 2}}
# class, option -> its smallest and largest allowed values, and the nearest that are refused
LIMITS: dict[tuple[type, str], tuple[tuple[Any, ...], tuple[Any, ...]]] = {
    (Polynomial, "lags"): ((1, 100), (0, 101, 2.5, True)),
    (Polynomial, "delays"): (((0,), (2,), None), ((-1,), (3,), ())),
    (Polynomial, "input_range"): ((((0.0, 1.0),), None), (((1.0, 1.0),), ())),
    (Polynomial, "output_range"): ((((0.0, 1.0),), None), (((1.0, 1.0),), ())),
    (Polynomial, "on_out_of_range"): (("clip", "refuse"), ("warn",)),
    (Polynomial, "set"): (("3.8", None), ("2.9",)),
    (Degrees, "left"): ((1, 9), (0, 2, 11)),
    (Degrees, "past"): ((1, 5), (0, 6)),
    (Degrees, "inputs"): ((0, 5), (-1, 6)),
    (Degrees, "leading"): ((0, 5), (-1, 6)),
    (Degrees, "lagged"): ((0, 5), (-1, 6)),
    (FilterMapFilter, "orders"): (((1, 0), (0, 100)), ((0, 0), (-1, 2), (101, 0), (1,))),
    (FilterMapFilter, "phases"): ((1, 4), (0, 5)),
    (FilterMapFilter, "intervals"): ((1, 1000), (0, 1001)),
    (FilterMapFilter, "starts"): ((1, 1000), (0, 1001)),
    (FilterMapFilter, "begin"): (("measured", "rest"), ("motion",)),
    (CellRow, "cells"): ((1, 3), (0, 4, 1.5)),
    (CellRow, "intervals"): ((1, 30), (0, 31)),
    (CellRow, "limit"): (("top", "friction", "none"), ("saturation",)),
    (Feedback, "lags"): ((1, 8), (0, 9)),
    (Feedback, "intervals"): ((1, 30), (0, 31)),
    (Feedback, "stages"): ((1, 8), (0, 9)),
    (Feedback, "imitated"): ((0, 10_000), (-1, 10_001)),
    (Network, "start_samples"): ((3, 10_000), (0, 2, 10_001)),
    (Network, "seed"): ((0,), (-1, 0.5)),
    (Rse, "iterations"): ((1, 1000), (0, 1001, 2.5)),
    (Sem, "iterations"): ((1, 1000), (0, 1001)),
}
FREE = {  # true or false, or options of their own
    (Rie, "accept_untested_repeats"),
    (Polynomial, "degrees"),
    (Network, "structure"),
    (Rse, "certified"),
    (Sem, "certified"),
}
OTHER_COMBINATIONS: tuple[tuple[Degrees, dict[str, Any], str], ...] = (
    (Degrees(left=3, past=2), {}, "needs ranges in set 2.11"),
    (Degrees(left=3, past=3), {"set": "2.13", "lags": 1}, "needs the degree left 5, or"),
    (Degrees(left=1, past=2), {"set": "2.13", "lags": 1}, "needs the degree left 3"),
    (Degrees(left=3, lagged=1), {}, "stable in ranges only"),
    (Degrees(left=5), {"set": "3.8"}, "left is 5; it should be 1 or 3"),
    (Degrees(left=3, inputs=2), {"set": "3.8"}, "affine in past outputs and inputs"),
    (Degrees(left=3), {"set": "2.13", "lags": 2}, "set 2.13 is for 1 lag"),
    (Degrees(left=3), {"set": "2.19"}, "set 2.19 is linear"),
    (Degrees(left=3), {"set": "2.11", "input_range": ((0.0, 1.0),)}, "or neither"),
    (Degrees(left=3, leading=1), {}, "no factor of y"),
)


@pytest.mark.parametrize(("kind", "key"), LIMITS, ids=lambda part: getattr(part, "__name__", part))
def test_an_option_is_taken_up_to_its_limits_and_refused_beyond(kind: type, key: str) -> None:
    least = NEEDED.get(kind, {})
    allowed, refused = LIMITS[kind, key]
    for value in allowed:
        assert getattr(kind(**least | {key: value}), key) == value
    for value in refused:
        with pytest.raises(OptionError) as caught:
            kind(**least | {key: value})
        assert str(caught.value).startswith(f"{key} is {value!r}; it should be ")
        assert isinstance(caught.value, DataError)
        assert str(pickle.loads(pickle.dumps(caught.value))) == str(caught.value)


def test_every_option_of_every_class_and_method_has_its_limits_tested() -> None:
    kinds = [Polynomial, Degrees, Network, FilterMapFilter, CellRow, Feedback, *METHODS.values()]
    options = {(kind, option.name) for kind in kinds for option in fields(kind)}
    assert options == set(LIMITS) | FREE


@pytest.mark.parametrize(("degrees", "options", "reason"), OTHER_COMBINATIONS)
def test_what_no_model_can_satisfy_is_refused(
    degrees: Degrees, options: dict[str, Any], reason: str
) -> None:
    with pytest.raises(DataError, match=reason):
        Polynomial(degrees=degrees, **options)


def test_options_cannot_be_changed_after_they_were_checked() -> None:
    with pytest.raises(FrozenInstanceError):
        Rse().iterations = 0  # type: ignore[misc]


def test_a_word_and_a_title_belong_to_one_method() -> None:
    assert all(METHODS[word].word == word for word in METHODS)
    assert {Rse().name, Rse(certified=True).name} == {"rse", "rse_certified"}
    assert len({method().title for method in METHODS.values()}) == len(METHODS) == 4


def test_the_methods_of_a_class_begin_with_the_one_that_is_taken() -> None:
    assert methods_of(Polynomial(2))[0] == Rse()
    assert methods_of(Polynomial(2, degrees=Degrees(left=3)))[0] == Rie()
    assert methods_of(Network(CellRow())) == (Sem(certified=True),)
    for degrees, certified in (((2, 0), True), ((1, 1), True), ((3, 0), False), ((2, 1), False)):
        made = Polynomial(2, degrees=Degrees(leading=degrees[0], lagged=degrees[1]))
        assert (Rse(certified=True) in methods_of(made)) is certified
    with pytest.raises(DataError, match="is no model class; there are: Polynomial, Network"):
        methods_of(LeastSquares())


def test_one_set_of_options_says_which_equations_are_searched() -> None:
    assert Polynomial(2).form is None
    assert Polynomial(2, degrees=Degrees(left=3)).form == "3.8"
    assert Polynomial(2, degrees=Degrees(left=3, inputs=2)).form == "2.11"
