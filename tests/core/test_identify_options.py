"""Options of classes and methods: each refusal names the option, its value and what is allowed."""

import pickle
from dataclasses import FrozenInstanceError, fields
from typing import Any

import pytest

from nlsid_core.errors import DataError, OptionError
from nlsid_core.identification import (
    METHODS,
    BlockCascadeClass,
    CellClass,
    CertifiedRse,
    CertifiedSem,
    FeedbackClass,
    ImplicitClass,
    LinearClass,
    LinearStateClass,
    MomentRie,
    MonotoneClass,
    Rse,
    StateAffineClass,
)
from nlsid_core.identification.methods.options import alike

LEAST_OPTIONS: dict[type, dict[str, Any]] = {
    LinearClass: {"lags": 1}, StateAffineClass: {"lags": 2}, MonotoneClass: {"lags": 1},
    BlockCascadeClass: {}, CellClass: {}, FeedbackClass: {}, ImplicitClass: {},
    LinearStateClass: {},
}  # fmt: skip
# class, option -> its smallest and largest allowed values, and the nearest that are refused
LIMITS: dict[tuple[type, str], tuple[tuple[Any, ...], tuple[Any, ...]]] = {
    (LinearClass, "lags"): ((1, 100), (0, 101, 2.5, True)),
    (StateAffineClass, "lags"): ((2, 100), (0, 101)),
    (StateAffineClass, "delays"): (((0,), (2,), None), ((-1,), (3,), ())),
    (StateAffineClass, "leading_degree"): ((0, 5), (-1, 6)),
    (StateAffineClass, "lagged_degree"): ((0, 5), (-1, 6)),
    (StateAffineClass, "right_degree"): ((0, 5), (-1, 6)),
    (StateAffineClass, "input_range"): ((((0.0, 1.0),), None), (((1.0, 1.0),), ())),
    (StateAffineClass, "on_out_of_range"): (("clip", "refuse"), ("warn",)),
    (StateAffineClass, "weights"): ((None, (1.0, 2.5)), ((), (0.0, 1.0), (float("nan"),))),
    (MonotoneClass, "lags"): ((1, 100), (0, 101)),
    (MonotoneClass, "delays"): (((0,), (100,)), ((-1,), (101,))),
    (MonotoneClass, "degree"): ((1, 3), (2,)),
    (BlockCascadeClass, "orders"): (((1, 0), (0, 100)), ((0, 0), (-1, 2), (101, 0), (1,))),
    (BlockCascadeClass, "phases"): (((1,), (4,)), ((0,), (5,), ())),
    (BlockCascadeClass, "intervals"): (((1,),), ((0,), ())),
    (BlockCascadeClass, "smoothing"): (((0.0,),), ((-1e-9,), (float("nan"),), ())),
    (BlockCascadeClass, "starts"): ((1, 1000), (0, 1001)),
    (BlockCascadeClass, "start_samples"): ((1,), (0,)),
    (BlockCascadeClass, "seed"): ((0,), (-1, 0.5)),
    (BlockCascadeClass, "begin"): (("measured", "rest"), ("motion",)),
    (CellClass, "cells"): ((1, 3), (0, 4, 1.5)),
    (CellClass, "intervals"): ((1, 30), (0, 31)),
    (CellClass, "start_samples"): ((1, 10_000), (0, 10_001)),
    (CellClass, "limit"): (("top", "friction", "none"), ("saturation",)),
    (CellClass, "smoothing"): ((0.0, 1.0), (-1e-9, float("nan"), float("inf"))),
    (FeedbackClass, "lags"): ((1, 8), (0, 9)),
    (FeedbackClass, "intervals"): ((1, 30), (0, 31)),
    (FeedbackClass, "stages"): ((1, 8), (0, 9)),
    (FeedbackClass, "imitated"): ((0, 10_000), (-1, 10_001)),
    (FeedbackClass, "start_samples"): ((3, 10_000), (0, 2, 10_001)),
    (FeedbackClass, "seed"): ((0,), (-1, 0.5)),
    (ImplicitClass, "lags"): ((1, 100), (0, 101)),
    (ImplicitClass, "delays"): (((0,), (100,)), ((-1,), (101,))),
    (ImplicitClass, "set"): (("2.10", "2.11", "2.12", "2.13"), ("2.9",)),
    (ImplicitClass, "left_degree"): ((1, 9), (0, 2, 11)),
    (ImplicitClass, "right_degree"): ((1,), (0, 6)),
    (ImplicitClass, "input_degree"): ((1, 5), (0, 6)),
    (ImplicitClass, "storage_degree"): ((0,), (-1, 5)),
    (ImplicitClass, "box"): ((((0.0, 1.0),), None), (((1.0, 1.0),), ())),
    (Rse, "iterations"): ((1, 1000), (0, 1001, 2.5)),
    (CertifiedRse, "iterations"): ((1, 1000), (0, 1001)),
    (CertifiedSem, "iterations"): ((1, 1000), (0, 1001)),
}
FREE = {
    (MomentRie, "accept_untested_repeats"), (ImplicitClass, "coupled"),
    (ImplicitClass, "continuous"),
}  # true or false  # fmt: skip


@pytest.mark.parametrize(("kind", "key"), LIMITS, ids=lambda part: getattr(part, "__name__", part))
def test_an_option_is_taken_up_to_its_limits_and_refused_beyond(kind: type, key: str) -> None:
    least = LEAST_OPTIONS.get(kind, {})
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
    kinds = [*LEAST_OPTIONS, *METHODS.values()]
    options = {(kind, option.name) for kind in kinds for option in fields(kind)}
    assert options == set(LIMITS) | FREE


def test_options_cannot_be_changed_after_they_were_checked() -> None:
    with pytest.raises(FrozenInstanceError):
        Rse().iterations = 0  # type: ignore[misc]


def test_a_name_and_a_title_belong_to_one_method() -> None:
    assert all(METHODS[name].name == name for name in METHODS)
    assert len({method.title for method in METHODS.values()}) == len(METHODS)


def test_what_runs_beside_a_method_takes_over_the_options_that_both_have() -> None:
    assert alike(Rse, CertifiedSem(iterations=3)) == Rse(iterations=3)
    assert alike(MomentRie, Rse(iterations=3)) == MomentRie()
