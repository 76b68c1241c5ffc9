"""What a notebook does with libraries that nlsid runs without: matplotlib and python-control."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from nlsid_core.data.trajectory import Dataset
from nlsid_core.designs import AnyDesign
from nlsid_core.identification import Model
from nlsid_core.models import DifferenceEquation


def plot(
    shown: Dataset | AnyDesign, models: Mapping[str, Model] | None = None, output: int = 0
) -> Any:
    """Draw what was measured on trials and what models simulate of them, or a design's tube.

    Args:
        shown: a design, or trials: of many, those that the last model simulates worst.
        models: for trials, by the names that the legend shows, such as `fit.model`.
        output: for trials, the number of the response.

    Returns:
        A matplotlib Figure; `savefig` writes it.
    """
    from bags.pictures import model_plots, tubes

    if isinstance(shown, Dataset):
        return model_plots.simulations(shown, models or {}, output)
    return tubes.draw_tube(shown)


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
