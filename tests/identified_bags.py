"""Bags of robots with a known truth, for every model class."""

from pathlib import Path
from typing import Any

import numpy as np
import yaml

from bags.chain.joint_bags import write_joint_bag
from nlsid_core.arrays import FloatArray
from nlsid_core.data.trajectory import Trajectory
from nlsid_core.models import BlockCascade, Signal, Spline

PERIOD = 0.01
MIMO = (
    np.array([[1.1, 0.1], [-0.1, 0.9]]),
    np.array([[-0.4, 0.0], [0.0, -0.3]]),
    np.array([[0.5, 0.1], [0.2, -0.4]]),
)
SPLIT = {"test": ["run_5"]}
FUNNEL: dict[str, Any] = {"funnel": {"safety_factor": 1.5}}
# identification sections, of bags with one output and with two
ONE: dict[str, dict[str, Any]] = {
    "linear": {"model": "linear", "lags": 3, "iterations": 3},
    "block_cascade": {
        "model": "block_cascade",
        "orders": [2, 1],
        "intervals": 8,
        "starts": 4,
        "transient": 60,
    },
    "cells": {"model": "cells", "intervals": 4},
    "monotone": {"model": "monotone", "lags": 2, "method": "rie"},
    "implicit": {"model": "implicit", "lags": 2},
}
TWO: dict[str, dict[str, Any]] = {
    "state_affine": {"model": "state_affine", "lags": 2, "iterations": 2, "leading_degree": 0},
    "linear_states": {"model": "linear_states"},
}


def saturating() -> BlockCascade:
    """A filter, a saturation, a filter."""
    f = Spline(-3.0, 0.5, np.tanh(np.arange(-3.5, 3.75, 0.5)))
    return BlockCascade(
        a1=np.array([1.2, -0.5]),
        b1=np.array([[0.2, 0.1, 0.0]]),
        f=f,
        a2=np.array([0.7]),
        b2=np.array([[0.5, 0.2]]),
        period=PERIOD,
        y=Signal("y"),
        u=Signal("u"),
    )


def write_bag(folder: Path, name: str, y: FloatArray, u: FloatArray, group: str = "") -> Path:
    """Columns of y as joint positions, of u as efforts; joints without either read zero."""
    joints = max(y.shape[1], u.shape[1])
    states, efforts = np.zeros((len(y), 2 * joints)), np.zeros((len(u), joints))
    states[:, : y.shape[1]], efforts[:, : u.shape[1]] = y, u
    t = PERIOD * np.arange(len(y))
    return write_joint_bag(folder, Trajectory(t=t, y=states, u=efforts, name=name, group=group))


def write_saturating_bags(folder: Path) -> Path:
    """Six trials of unequal length: run_0 and run_1, run_2 and run_3 repeat one excitation."""
    for k in range(6):
        excitation, group = (k // 2, f"excitation {k // 2}") if k < 4 else (k, "")
        samples = 200 + 20 * excitation
        u = np.random.default_rng(excitation).uniform(-2.0, 2.0, samples)
        y = saturating().simulate(u) + 0.01 * np.random.default_rng(100 + k).standard_normal(
            samples
        )
        write_bag(folder, f"run_{k}", y[:, None], u[:, None], group)
    return folder


def write_coupled_bags(folder: Path) -> Path:
    """Six trials of two outputs that influence each other, driven by two inputs."""
    A1, A2, B = MIMO
    for k in range(6):
        rng = np.random.default_rng(k)
        u = rng.standard_normal((150 + 10 * k, 2))
        y = np.zeros_like(u)
        for t in range(2, len(u)):
            y[t] = A1 @ y[t - 1] + A2 @ y[t - 2] + B @ u[t - 1]
        write_bag(folder, f"run_{k}", y + 0.01 * rng.standard_normal(y.shape), u)
    return folder


def write_config(path: Path, identification: dict[str, Any], **sections: Any) -> Path:
    """A configuration of the bags above; `outputs`, `inputs`: how many signals."""
    outputs, inputs = sections.pop("outputs", 1), sections.pop("inputs", 1)
    content = {
        "robot": "a simulated robot",
        "signals": {
            "response": [
                {"name": f"angle {i}", "unit": "rad", "path": f"/joint_states:position[{i}]"}
                for i in range(outputs)
            ],
            "excitation": [
                {"name": f"torque {i}", "unit": "N m", "path": f"/joint_commands:effort[{i}]"}
                for i in range(inputs)
            ],
        },
        "grid": {"period": PERIOD, "max_gap": 0.05},
        "split": SPLIT,
        "identification": identification,
    } | sections
    path.write_text(yaml.safe_dump(content))
    return path
