"""What a notebook does with libraries that nlsid runs without: matplotlib and python-control."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from nlsid_core.data.trajectory import Dataset
from nlsid_core.identification import Model
from nlsid_core.models import DifferenceEquation


def plot(data: Dataset, models: Mapping[str, Model], output: int = 0) -> Any:
    """Draw what was measured on trials and what models simulate of them, as a matplotlib Figure.

    Args:
        data: the trials; of many, those that the last model simulates worst.
        models: by the names that the legend shows, such as `fit.model`.
        output: the number of the response.

    Returns:
        The Figure; `savefig` writes it.
    """
    from bags.pictures.model_plots import simulations

    return simulations(data, models, output)


def to_control(model: DifferenceEquation) -> Any:
    """Make a linear model a discrete TransferFunction of python-control: steps, Bode, margins.

    Its input and output are called as the model's, with "_" for "." (python-control allows none).
    The constant c is the output's offset, and no part of it. Source: (4.1).
    """
    import control

    u, y = (signal.name.replace(".", "_") for signal in (model.u, model.y))
    return control.TransferFunction(
        model.b, np.append(1.0, -model.a), model.period, inputs=[u], outputs=[y]
    )
