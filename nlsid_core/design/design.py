"""`design`: a problem in; policy, funnel and proof out, whatever the kind.

Each kind has one search, which the kernel decides before anything is returned.
"""

from __future__ import annotations

from typing import get_args, overload

from nlsid_core.design.continuous.design import FunnelDesign, design_funnel
from nlsid_core.design.continuous.problem import ContinuousTracking
from nlsid_core.design.problems import OutputTube, Problem, SampledTracking
from nlsid_core.design.sampled.design import TrackingDesign, design_state_funnel
from nlsid_core.design.tube import OutputTubeDesign, design_output_tube
from nlsid_core.errors import DataError
from nlsid_core.progress import Progress, silent


@overload
def design(problem: OutputTube) -> OutputTubeDesign: ...
@overload
def design(problem: SampledTracking, *, progress: Progress = silent) -> TrackingDesign: ...
@overload
def design(
    problem: ContinuousTracking,
    *,
    progress: Progress = silent,
) -> FunnelDesign: ...
def design(
    problem: OutputTube | SampledTracking | ContinuousTracking,
    *,
    progress: Progress = silent,
) -> OutputTubeDesign | TrackingDesign | FunnelDesign:
    """A funnel for the problem, proved, and a policy unless it needs none.

    `Design.save` writes them and the proof.

    progress: called with (what was done, fraction done).
    Raises DataError on a problem that makes no sense, Infeasible if no funnel was found or proved,
    CertificateRejected if an assumption is not one that the kernel accepts.
    """
    if type(problem) not in get_args(Problem):
        kinds = ", ".join(kind.__name__ for kind in get_args(Problem))
        raise DataError(f"the problem should be one of {kinds}, is {problem!r}")
    match problem:
        case OutputTube():
            return design_output_tube(problem)
        case SampledTracking():
            return design_state_funnel(problem, progress=progress)
        case ContinuousTracking():
            return design_funnel(problem, progress=progress)
