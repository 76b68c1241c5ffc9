"""Problems of funnels as files have them (docs/howto-funnels.md)."""

from typing import Any

import numpy as np

from nlsid import Goal, Nominal, VectorField
from nlsid_core import files
from nlsid_core.arrays import Json


def document(field: VectorField, nominal: Nominal, goal: Goal, **options: Any) -> Json:
    """The JSON form of a problem; every number round-trips exactly."""
    return {
        "format": "nlsid/funnel_problem",
        "version": files.VERSION,
        "vector_field": field.document(),
        "nominal": {
            "t": nominal.t.tolist(),
            "x": nominal.x.control.tolist(),
            "u": nominal.u.control.tolist(),
        },
        "goal": {"centre": goal.centre.tolist(), "P": goal.P.tolist()},
        **{name: np.asarray(value).tolist() for name, value in options.items()},
    }
