"""Several funnels at once: each reads exactly what it reads alone."""

import pytest

from nlsid_core.data.trajectory import Dataset
from nlsid_core.design import OutputTube, OutputTubeDesign, design_output_tube
from nlsid_core.errors import CertificateMismatch, DataError
from nlsid_core.running.comparison import Centre
from nlsid_core.running.monitor import Monitor
from nlsid_core.running.reading import Status
from tests.conftest import synthetic_dataset


@pytest.fixture(scope="module")
def designs(design: OutputTubeDesign, train: Dataset) -> list[OutputTubeDesign]:
    """Tubes for one model with other profiles, horizons and safety factors."""
    return [
        design_output_tube(
            OutputTube(
                design.model,
                train,
                profile=[(0.0, 0.0), (1.0, 0.0), (3.0, 0.3 + 0.02 * i), (7.0, 0.4)],
                horizon=5.0 + 0.2 * i,
                safety_factor=1.0 + 0.1 * i,
                inlet=0.01 * i,
            )
        )
        for i in range(4)
    ]


@pytest.mark.parametrize("centre", [centre for centre in Centre if centre is not Centre.MOTION])
@pytest.mark.parametrize("scale", [1.0, 0.6])
def test_a_bank_reads_bit_for_bit_what_each_monitor_reads_alone(
    designs: list[OutputTubeDesign], train: Dataset, centre: Centre, scale: float
) -> None:
    bank = Monitor.of_several(
        designs[0].model, [(d.policy, d.funnel) for d in designs], centre=centre
    )
    alone = [Monitor(d.model, d.policy, d.funnel, centre=centre) for d in designs]
    seen = set()
    for trial in train:
        bank.restart()
        for monitor in alone:
            monitor.restart()
        samples = zip(trial.t, scale * trial.y[:, 0], trial.u[:, 0], strict=True)
        for t, y, u in samples:
            together = bank.readings(t, y, u)
            separately = [monitor.update(t, y, u) for monitor in alone]
            assert list(map(repr, together)) == list(map(repr, separately))
            seen |= {reading.status for reading in together}
    assert Status.UNKNOWN in seen, "samples that start a run"
    assert len(seen) >= 2


def test_a_bank_of_a_robot_in_motion_begins_when_the_slowest_start_has_faded(
    designs: list[OutputTubeDesign],
) -> None:
    [trial] = synthetic_dataset(0.01, trials=1, samples=400)
    bank = Monitor.of_several(
        designs[0].model, [(d.policy, d.funnel) for d in designs], centre=Centre.MOTION
    )
    alone = [Monitor(d.model, d.policy, d.funnel, centre=Centre.MOTION) for d in designs]
    samples = list(zip(trial.t, trial.y[:, 0], trial.u[:, 0], strict=True))
    begun = [
        next(
            k
            for k, sample in enumerate(samples)
            if monitor.update(*sample).status is not Status.UNKNOWN
        )
        for monitor in alone
    ]
    assert min(begun) < max(begun)
    for k, sample in enumerate(samples):
        unknown = {reading.status is Status.UNKNOWN for reading in bank.readings(*sample)}
        assert unknown == {k < max(begun)}


def test_a_bank_refuses_no_funnel_and_another_models_funnel(
    designs: list[OutputTubeDesign],
) -> None:
    with pytest.raises(DataError, match="no funnel"):
        Monitor.of_several(designs[0].model, [])
    with pytest.raises(CertificateMismatch, match="another policy"):
        Monitor.of_several(designs[0].model, [(designs[0].policy, designs[1].funnel)])
