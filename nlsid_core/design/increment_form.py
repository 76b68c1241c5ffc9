"""`Form`: a model's increment form in floats, as the program that looks for a tube needs it."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from nlsid_core import files
from nlsid_core.arrays import FloatArray, Json
from nlsid_core.errors import Infeasible
from nlsid_core.identification.proofs.stability import prove_stability, storage_on
from nlsid_core.kernel import increments
from nlsid_core.kernel.files import parse
from nlsid_core.kernel.increments import Box
from nlsid_core.kernel.models import read_model
from nlsid_core.models import StableModel

CORNERS = 16  # vertices whose Gramians balance a program
FADING = (0.85, 0.6, 0.35, 0.2, 0.08)  # 1 - ρ as parts of 1 - rate²


def read_form(model: StableModel, bounds: Json | None) -> increments.Model:
    """As the kernel reads it; kernel.Rejected if it needs a box, or needs none."""
    node = None if bounds is None else parse(files.encode(bounds), "box")
    return read_model(parse(files.encode(model.document()), "model"), node)


@dataclass(frozen=True, eq=False)
class Form:
    """The increment form in floats. modes: (F, H), and a second with a policy engaged.

    tree: of a proof's multipliers, with the vertices E of each of its leaves in order, (count, m,
    m + n); None without ν.
    """

    modes: list[tuple[FloatArray, FloatArray]]
    tree: Json | None
    leaves: list[FloatArray]
    ray: bool
    rate: float
    inputs: tuple[FloatArray, FloatArray] | None
    storage: FloatArray

    @classmethod
    def of(cls, model: StableModel, bounds: Json | None, K: FloatArray | None = None) -> "Form":
        """Read a model's form, perhaps on the box `bounds` {y, u}, perhaps with a policy's K (n,).

        Raises Infeasible if no storage proves that it forgets its start.
        """
        form = read_form(model, bounds)
        proof = prove_stability(model) if bounds is None else storage_on(form)
        if proof is None:
            where = bounds and "; ".join(
                f"{letter} in {', '.join(f'[{low:.3g}, {high:.3g}]' for low, high in rows)}"
                for letter, rows in bounds.items()
            )
            raise Infeasible(
                "no one storage proves that the model forgets its start, so no tube of it lasts"
                + (
                    f": tried for {where}, the `box` of the tube or else a tenth more than the "
                    "training trials reach; take a smaller one, another `set`, or fewer lags"
                    if where
                    else ""
                )
            )
        F, H = (np.array(part, dtype=np.float64) for part in (form.F, form.H))
        leaves: list[FloatArray] = [
            np.array(form.E.vertices(part), dtype=np.float64)
            for part in _parts(proof.multipliers, form.E.box)
        ]
        inputs = None
        if form.linear is not None:
            B, D = (np.array(v, dtype=np.float64) for v in (form.linear.B, [form.linear.D]))
            inputs = B[:, None], D[:, None]
        modes: list[tuple[FloatArray, FloatArray]] = [(F, H)]
        if K is not None and K.any() and inputs is not None:
            modes.append((F - np.outer(inputs[0], K), H - inputs[1] * K))
        storage = np.linalg.inv(proof.P)
        return cls(modes, proof.multipliers, leaves, form.E.ray, proof.rate, inputs, storage)

    @property
    def F(self) -> FloatArray:
        """x̄⁺ of (ν, x̄), without a policy."""
        return self.modes[0][0]

    @property
    def H(self) -> FloatArray:
        """o of (ν, x̄), without a policy."""
        return self.modes[0][1]

    @cached_property
    def mean(self) -> FloatArray:
        """(m, m + n) of the vertices E."""
        if not self.m:
            return np.zeros((0, len(self.F)))
        return np.asarray(np.mean([E.mean(axis=0) for E in self.leaves], axis=0))

    @cached_property
    def A(self) -> FloatArray:
        """x̄⁺ of x̄ at the mean of E."""
        return _closed(self.F, self.mean)

    @cached_property
    def C(self) -> FloatArray:
        """o of x̄ at the mean of E."""
        return _closed(self.H, self.mean)

    @property
    def corners(self) -> list[FloatArray]:
        """x̄⁺ of x̄ where E is one of its vertices, of a few: one of them may be much slower."""
        vertices = [E for leaf in self.leaves for E in leaf]
        if not self.m:
            return [self.A]
        chosen = vertices[:: max(1, len(vertices) // CORNERS)]
        return [_closed(self.F, E) for E in chosen]

    @property
    def m(self) -> int:
        """The number of ν."""
        return int(self.F.shape[1] - len(self.F))

    def fading(self) -> list[float]:
        """ρ between rate² and 1."""
        return [1.0 - part * (1.0 - self.rate**2) for part in FADING]


def _closed(rows: FloatArray, E: FloatArray) -> FloatArray:
    """Rows of (ν, x̄) as rows of x̄, where E (ν, x̄) = 0."""
    m = len(E)
    return np.asarray(rows[:, m:] - rows[:, :m] @ np.linalg.solve(E[:, :m], E[:, m:]))


def _parts(tree: Json | None, box: Box) -> list[Box]:
    """The leaves' parts of the box."""
    if tree is None:
        return []
    if "split" not in tree:
        return [box]
    i = tree["split"]
    low, high = box[i]
    middle = (low + high) / 2
    halved = ([*box[:i], half, *box[i + 1 :]] for half in ((low, middle), (middle, high)))
    return [
        leaf
        for part, half in zip(tree["parts"], halved, strict=True)
        for leaf in _parts(part, half)
    ]
