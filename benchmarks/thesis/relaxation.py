"""The time-sampled relaxation, thesis (6.7): ρ(t) that holds at instants. It is not a proof.

Between the instants anything may happen, so what is found is at least as large as what is true.
`Sampled` has no certificate and nothing that could become one: only `design_funnel` proves.
"""

from dataclasses import dataclass, replace

import numpy as np

from nlsid_core import files
from nlsid_core.design import ContinuousTracking
from nlsid_core.design.continuous.setting import prepare
from nlsid_core.design.continuous.sweep import swept, wanted_of
from nlsid_core.errors import DataError
from nlsid_core.funnels.continuous import ContinuousFunnel
from nlsid_core.progress import Progress, silent


@dataclass(frozen=True, eq=False)
class Sampled:
    """A set that holds at sampled instants, which is no proof, and ∫ volume dt of every iterate."""

    funnel: ContinuousFunnel
    volumes: tuple[float, ...]

    def __str__(self) -> str:
        return (
            f"NOT PROVED: holds at samples only, volume integral {self.volumes[-1]:.4g} over "
            f"{self.funnel.t0:g} to {self.funnel.tf:g} s"
        )


def sample_funnel(
    problem: ContinuousTracking, *, samples: int = 4, progress: Progress = silent
) -> Sampled:
    """The largest ρ(t) that holds at `samples` instants of every interval, both ends among them.

    Necessary for a funnel with this P(t), not sufficient: to compare with, or to see what could be
    hoped for. Raises what `design_funnel` does.
    """
    if samples < 2:
        raise DataError(f"{samples} samples an interval: its two ends are the least")
    setting = prepare(problem)
    policy = setting.policy
    shares = np.linspace(0, 1, samples).tolist()
    bare = replace(setting, expansion=None)
    rho = swept(bare, wanted_of(setting), progress, shares=shares).rho
    digest = files.digest(policy.document())
    funnel = ContinuousFunnel(policy.x, setting.P, rho, policy.vector_field, digest)
    return Sampled(funnel, (funnel.volume_integral(),))
