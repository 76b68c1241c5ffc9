"""Standard errors of a model's coefficients, by how its simulation changes with each of them.

Of 0 = Σ_k G_k(w) ȳ(t-k) + p(w) the derivative of the simulation in a coefficient θ follows
    ∂ȳ(t)/∂θ = gains [∂ȳ(t-1)/∂θ; …; ∂ȳ(t-n)/∂θ] - G_0⁻¹ ∂(Σ_k G_k ȳ(t-k) + p)/∂θ, ȳ held,
and J stacks them over all samples. A minimum of the simulation error has the covariance
    (J'J)⁻¹ (Σ_t J_t' Λ J_t) (J'J)⁻¹,   Λ that of the errors; σ² (J'J)⁻¹ for one output.
Source: Ljung, System Identification, Section 9.3, of an output error.
"""

import numpy as np

from nlsid_core.arrays import FloatArray
from nlsid_core.data.trajectory import Dataset, Trajectory
from nlsid_core.errors import DataError
from nlsid_core.identification.prediction import as_state_affine, simulate_trial
from nlsid_core.models import DifferenceEquation, StateAffineModel
from nlsid_core.polynomial.values import monomial_values
from nlsid_core.shown import Table


def standard_errors(model: DifferenceEquation | StateAffineModel, data: Dataset) -> Table:
    """Give the coefficients with their standard errors, by the trials that they were fitted to.

    They are right for a minimum of the simulation error (`Sem`) with white errors; `validate` says
    whether the errors are white.

    Args:
        model: linear, or state-affine.
        data: the trials that it was fitted to.

    Returns:
        A row for each coefficient: value, standard error. [name] is the latter. A linear model has
        a1 ... an, b0 ... bn and c. A state-affine one has those of G0, G1, ... and p with their
        monomials, for normalised signals: `G1 u(t)^2`, of several outputs `G1[1,2] u1(t-1)`. The
        first of G0 has none: a common factor of all coefficients changes nothing, so it is held.

    Raises:
        DataError: for another class of models, and where the data do not determine all of them.
    """
    if isinstance(model, DifferenceEquation):
        equation, values = as_state_affine(model), _linear_values(model)
    elif isinstance(model, StateAffineModel):
        equation, values = model, _state_affine_values(model)
    else:
        raise DataError("standard errors are those of a linear or a state-affine model")
    each = (_slopes(equation, trial) for trial in data)
    J, e = (np.concatenate(part) for part in zip(*each, strict=True))
    _, n_y, unknowns = J.shape
    R = np.linalg.qr(J.reshape(-1, unknowns), mode="r")
    if np.linalg.matrix_rank(R) < unknowns:
        raise DataError("the inputs of these trials do not determine all numbers of the model")
    inverse = np.linalg.inv(R)
    noise = e.T @ e / (len(e) - unknowns / n_y)
    moved = J @ inverse
    middle = np.einsum("tip,ij,tjq->pq", moved, noise, moved, optimize=True)
    errors = np.sqrt(np.diag(inverse @ middle @ inverse.T)).tolist()
    rows = zip(values.items(), errors, strict=True)
    return Table(
        ("value", "standard error"), {name: (value, error) for (name, value), error in rows}
    )


def _slopes(model: StateAffineModel, trial: Trajectory) -> tuple[FloatArray, FloatArray]:
    """J (T, n_y, m) of all coefficients but G_0's first, and ȳ - its simulation (T, n_y)."""
    n, n_y, w = len(model), len(model.y), model.windows(trial.u)
    simulated = (simulate_trial(model, trial) - model.y_offset) / model.y_scale
    measured = (trial.y - model.y_offset) / model.y_scale
    gains, _ = model.explicit(w)

    lagged = [simulated[n - k : len(trial) - k] for k in range(n + 1)]
    factors = [*lagged, np.ones((len(w), 1))]  # of G_0 … G_n, and of p
    blocks = []
    for part, factor in zip((*model.G, model.p), factors, strict=True):
        values = monomial_values(part.exponents, w)
        block = np.einsum("tj,ia,tb->tijab", values, np.eye(n_y), factor)
        blocks.append(block.reshape(len(w), n_y, -1))
    direct = -np.linalg.solve(model.G[0](w), np.concatenate(blocks, axis=2)[:, :, n_y**2 :])

    J = np.zeros((len(trial), *direct.shape[1:]))
    for t in range(n, len(trial)):
        past = J[t - n : t][::-1].reshape(n * n_y, -1)
        J[t] = gains[t - n] @ past + direct[t - n]
    return J[n:], (measured - simulated)[n:]


def _linear_values(model: DifferenceEquation) -> dict[str, float]:
    a = ((f"a{k}", value) for k, value in enumerate(model.a.tolist(), 1))
    b = ((f"b{j}", value) for j, value in enumerate(model.b.tolist()))
    return dict([*a, *b, ("c", model.c)])


def _state_affine_values(model: StateAffineModel) -> dict[str, float]:
    """The coefficients by name, in the order of `_slopes`."""
    inputs = ["u"] if len(model.u) == 1 else [f"u{i + 1}" for i in range(len(model.u))]
    past = [f"{inputs[i]}(t-{d})".replace("(t-0)", "(t)") for i, d in model.window]
    found, n_y = {}, len(model.y)
    heads = [*(f"G{k}" for k in range(len(model.G))), "p"]
    for head, part in zip(heads, (*model.G, model.p), strict=True):
        for (j, *at), value in np.ndenumerate(part.coefficients):
            where = f"[{','.join(str(i + 1) for i in at)}]" if n_y > 1 else ""
            powers = zip(past, part.exponents[j].tolist(), strict=True)
            terms = [f"{name}^{k}".removesuffix("^1") for name, k in powers if k]
            found[" ".join([head + where, *terms])] = float(value)
    return dict(list(found.items())[n_y**2 :])
