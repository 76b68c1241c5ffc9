"""The sphere program for one state: the boundary is two points, and everything is closed form.

g is a + bz on z = ±1, so m = a - |b| and g - m ≡ |b|(1 ± z) ≡ ½|b|(z ± z²)² there.
"""

from dataclasses import dataclass, field

import numpy as np

from nlsid_core.arrays import ArrayLike, FloatArray, IntArray
from nlsid_core.sos.sphere import Iterate, SphereSolution


@dataclass(frozen=True, eq=False)
class LineProgram:
    """What `SphereProgram` is for two and more variables; v = (z, z²), points z = 1 and z = -1.

    half: of the degree of the polynomial whose values are given; it has no part in the solution.
    """

    half: int = 2
    n: int = 1
    constant: bool = False
    chosen: tuple[int, ...] = (0,)
    basis: IntArray = field(default_factory=lambda: np.array([[1], [2]]))
    weight: FloatArray = field(default_factory=lambda: np.sqrt(np.array([0.5, 0.5])))
    points: FloatArray = field(default_factory=lambda: np.array([[1.0], [-1.0]]))

    def solve(
        self,
        g: ArrayLike,
        *,
        tolerance: float = 1e-8,
        start: SphereSolution | None = None,
        enough: float = np.inf,
    ) -> SphereSolution:
        """Maximise m for the two values g; exact, whatever the tolerance and what is enough."""
        del tolerance, start, enough
        high, low = np.asarray(g, dtype=np.float64)
        a, b = (high + low) / 2, (high - low) / 2
        X = abs(b) / 2 * np.array([[1.0, np.sign(b)], [np.sign(b), 1.0]])
        y = np.array([1.0, 0.0]) if high <= low else np.array([0.0, 1.0])
        m = float(a - abs(b))
        return SphereSolution(m, m, X, y, 0.0, 0, (Iterate(X, y, m, 0.0),))

    def gram(self, solution: SphereSolution) -> FloatArray:
        """(2, 2) Gram matrix of the solution."""
        return solution.X
