"""How far out commissioning runs start, beside the inlet that is claimed."""

import numpy as np
import pytest

from bags.chain.tracking_steps import what_breaks, widest_start
from bags.monitoring.catching import OF_STATES
from nlsid_core.data.trajectory import Dataset
from tests.tracked import designed, run


@pytest.mark.slow
def test_the_widest_start_is_told_in_parts_of_the_inlet() -> None:
    made = designed()
    edge = np.linalg.solve(made.funnel.S[0], [float(made.funnel.inlet[0]), 0.0])
    runs = Dataset(
        tuple(
            run(seed=i, start=made.policy.x[0] + p * edge) for i, p in enumerate((0.1, -0.5, 0.0))
        )
    )
    assert widest_start(made, runs) == pytest.approx(0.5, abs=0.1)


def test_faults_that_break_the_assumption_are_counted_in_copies_of_the_runs() -> None:
    made = designed()
    runs = Dataset(tuple(run(seed=seed) for seed in range(3)))
    found = what_breaks(made, runs)
    assert found.trials == 3
    assert found.counts["stuck at first value"] == 3
    kicked = Dataset((run(seed=0, kick=np.array([0.0, 1.0])),))
    assert set(what_breaks(made, kicked).counts.values()) == {1}, "it breaks without a fault"
    ranges = np.zeros(2)
    (weak,) = [fault for name, fault in OF_STATES if name == "actuator x 0.8"]
    trial = runs.trajectories[0]
    np.testing.assert_allclose(0.8 * weak(trial, ranges, None).u, trial.u)
