"""How far out commissioning runs start, beside the inlet that is claimed."""

import numpy as np
import pytest

from bags.chain.tracking_steps import widest_start
from nlsid_core.data.trajectory import Dataset
from tests.tracked import designed, run


def test_the_widest_start_is_told_in_parts_of_the_inlet() -> None:
    made = designed()
    edge = np.linalg.solve(made.funnel.S[0], [float(made.funnel.inlet[0]), 0.0])
    runs = Dataset(tuple(run(seed=i, start=made.policy.x[0] + p * edge)
                         for i, p in enumerate((0.1, -0.5, 0.0))))  # fmt: skip
    assert widest_start(made, runs) == pytest.approx(0.5, abs=0.1)
