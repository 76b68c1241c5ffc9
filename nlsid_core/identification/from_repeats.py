"""`identify_from_repeats`: repeats in, a stable model without the bias of noise out."""

from concurrent.futures import Executor

from nlsid_core.errors import DataError
from nlsid_core.identification.moment_rie import MomentFit, minimise_moment_rie
from nlsid_core.identification.moments import MonotoneClass, offsets_of, repeated_moments
from nlsid_core.identification.repeats import refuse_false_repeats
from nlsid_core.trajectory import Dataset


def identify_from_repeats(
    data: Dataset,
    model_class: MonotoneClass,
    *,
    kappa: float | None = None,
    transient: int = 0,
    accept_untested_repeats: bool = False,
    executor: Executor | None = None,
) -> MomentFit:
    """Identify a `MonotoneEquation` from the dataset's groups of repeats, proved stable.

    Trajectories without a repeat are not used. transient: samples at the start of each that the
    test of the repeats leaves out. accept_untested_repeats: skip that test; the bias of noise is
    then removed only if the trials repeat one excitation all the same. executor: for the moments.
    Raises DataError if there are no repeats or they are not repeats, ShapeError for several
    outputs, Infeasible or SolverError as `minimise_moment_rie`.
    """
    groups = tuple(data.repeats().values())
    if not groups:
        raise DataError(
            "no two trajectories share a `group`: bias removal needs repeated experiments; without "
            "them use plain_moments, or another method"
        )
    if not accept_untested_repeats:
        refuse_false_repeats(data, transient=transient)
    offsets = offsets_of([trial for group in groups for trial in group])
    moments = repeated_moments(groups, model_class, offsets, executor=executor)
    return minimise_moment_rie(moments, model_class, groups[0][0], offsets, kappa=kappa)
