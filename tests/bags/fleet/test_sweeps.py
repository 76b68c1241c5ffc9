"""What is tried is the same to the last bit, whoever tries it."""

from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from typing import Any

import numpy as np
import pytest

from bags.fleet.workers import Workers
from nlsid_core.design import ContinuousTracking, design_funnel, integrate_nominal
from nlsid_core.dynamics import VectorField
from nlsid_core.errors import DataError
from tests.bags.fleet.deadly import die


def pendulum(x: Any, u: Any) -> Any:
    return np.array([x[1], -x[0] + x[0] ** 3 / 6 - x[1] / 5 + u[0]])


@pytest.mark.slow
def test_the_l_steps_of_a_funnel_are_the_same_whoever_solves_them() -> None:
    field = VectorField.from_function(pendulum, 2, 1)
    t = np.linspace(0, 1, 3)
    nominal = integrate_nominal(field, lambda _: np.zeros(1), t=t, start=np.zeros(2))
    problem = ContinuousTracking(field, nominal, goal=20 * np.eye(2), shape="P")
    here = design_funnel(problem)
    with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as executor:
        shared = design_funnel(problem, executor=executor)
    assert len(here.found.history) > 1
    assert here.found.history == shared.found.history
    assert here.funnel.document() == shared.funnel.document()


def test_a_sweep_whose_worker_dies_ends_with_a_sentence() -> None:
    def sweep(workers: Workers) -> list[None]:
        with workers.sharing() as executor:
            return [] if executor is None else list(executor.map(die, [0]))

    with pytest.raises(DataError, match="a worker died"):
        sweep(Workers(1))
    assert sweep(Workers()) == [], "in this process nothing is shared"
