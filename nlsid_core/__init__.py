"""From recorded data to provably stable models, proved funnels and live monitors.

The nouns of a funnel around a trajectory, and `load`, which reads whichever document a file holds.
"""

from nlsid_core.continuous import Funnel, Nominal, Policy, VectorField
from nlsid_core.documents import load

__all__ = ["Funnel", "Nominal", "Policy", "VectorField", "load"]
