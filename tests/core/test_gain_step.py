"""Gains with which V falls faster: a larger funnel for inputs that are no larger."""

import numpy as np
import pytest

from benchmarks.thesis.soundness import simulate_boundary, simulate_held
from nlsid_core.design import FunnelDesign, design
from nlsid_core.errors import DataError, OptionError
from tests.falling_pendulum import tracking

HOLD, ERROR = 0.01, [0.002, 0.01]  # s; rad and rad/s


def volume(found: FunnelDesign) -> float:
    return found.funnel.volume_integral()


@pytest.mark.slow
def test_a_gain_step_enlarges_a_proved_funnel_that_no_run_leaves() -> None:
    lqr, searched = design(tracking()), design(tracking(search_gain=True))
    assert volume(searched) > volume(lqr)
    assert not np.array_equal(searched.policy.K.control, lqr.policy.K.control)
    parts = searched.model, searched.policy, searched.funnel
    run = simulate_boundary(*parts, starts=500, rng=np.random.default_rng(5), substeps=10)
    assert run.violations == 0


@pytest.mark.slow
def test_a_gain_step_enlarges_a_held_funnel_that_no_run_leaves() -> None:
    lqr, searched = (
        design(tracking(hold=HOLD, error=ERROR, search_gain=flag)) for flag in (False, True)
    )
    assert volume(searched) > 1.2 * volume(lqr)
    parts = searched.model, searched.policy, searched.funnel
    run = simulate_held(
        *parts, hold=HOLD, error=np.array(ERROR), starts=500, rng=np.random.default_rng(5)
    )
    assert run.violations == 0


def test_gains_that_no_step_is_for_are_refused() -> None:
    with pytest.raises(DataError, match="gain='constant' or 'linear'"):
        design(tracking(gain="cubic", search_gain=True))
    with pytest.raises(OptionError, match="search_gain is 'no'; it should be one of False, True"):
        tracking(search_gain="no")
