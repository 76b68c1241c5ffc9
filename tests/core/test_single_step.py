"""One sample of an implicit model on plain numbers: the same as the step of whole arrays."""

from collections.abc import Callable

import numpy as np
import pytest

from nlsid_core.models import ImplicitModel
from nlsid_core.models.implicit_step import SingleStep
from tests import implicit_models
from tests.marks import slow_among

EVERY: dict[str, Callable[[], ImplicitModel]] = {
    "quintic": implicit_models.quintic,
    "coupled": implicit_models.coupled,
    "lagged": implicit_models.lagged,
    "cubic spring": implicit_models.cubic_spring,
    "linear": lambda: implicit_models.linear(np.array([[0.6, 0.3], [-0.2, 0.5]])),
}


@pytest.mark.parametrize("name", EVERY)
@pytest.mark.parametrize("size", slow_among([0.3, 3.0, 300.0], {300.0}))
def test_a_single_step_is_the_step_of_whole_arrays(name: str, size: float) -> None:
    """Also far away, where Newton's full steps fail and the model's own solver takes over."""
    model, rng = EVERY[name](), np.random.default_rng(0)
    single = SingleStep(model)
    for _ in range(50):
        x = size * rng.normal(size=(3, len(model)))
        w = size * rng.normal(size=len(model.inputs))
        expected = model.step(x, np.tile(w, (3, 1)))
        assert single(x, w) == pytest.approx(expected, rel=1e-8, abs=1e-8)
