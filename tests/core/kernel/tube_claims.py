"""A model of each class with a proved tube, as documents, and recordings to make them from."""

import json
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np

from nlsid_core import design as designing
from nlsid_core import files, proofs
from nlsid_core.arrays import FloatArray, Json
from nlsid_core.data.trajectory import Dataset, Trajectory
from nlsid_core.design import OutputTube, OutputTubeDesign
from nlsid_core.design.levels import LevelKind
from nlsid_core.funnels.level import LevelMeter
from nlsid_core.models import ImplicitModel, Signal
from nlsid_core.running.stepping import Stepper
from tests import implicit_models
from tests.core.kernel import stability_claims

MODEL, FUNNEL = "model.json", "funnel.json"


def recorded(model: ImplicitModel, *window: tuple[int, int]) -> ImplicitModel:
    """The model with names of recorded signals."""
    y = tuple(Signal(f"y{i}", "m", f"/y:data[{i}]") for i in range(model.unknowns))
    return replace(model, y=y, u=(Signal("u", "N", "/u:data"),), window=window)


# A design of each takes about a second.
LONG = {"two_following", "implicit_linear", "split", "network", "moving_lags", "cascade"}
MODELS: dict[str, Callable[[], Any]] = {
    **{
        name: stability_claims.MODELS[name]
        for name in (
            "linear",
            "quadratic",
            "moving_lags",
            "two_outputs",
            "split",
            "cascade",
            "network",
            "monotone",
        )
    },
    "implicit_ray": lambda: recorded(implicit_models.lagged(), (0, 0)),
    "implicit_linear": lambda: recorded(
        implicit_models.linear(np.array([[0.6, 0.3], [-0.2, 0.5]])), (0, 1)
    ),
    "implicit_box": lambda: recorded(implicit_models.cubic_spring(), (0, 0)),
    "following": stability_claims.MODELS["linear"],
    "two_following": stability_claims.MODELS["two_outputs"],
}
LOW, HIGH = -0.5, 0.9  # of the inputs: inside every model's range


def dataset(model: Any, seed: int, count: int = 5, samples: int = 120) -> Dataset:
    """Trials of the model with steps as inputs, noise on what it gets and on its outputs."""
    trials = []
    for k in range(seed, seed + count):
        rng, stepper = np.random.default_rng(k), Stepper(model)
        lags = max(stepper.lags, 1)
        u = np.repeat(rng.uniform(LOW, HIGH, (samples // 10, len(stepper.u))), 10, axis=0)
        y = np.zeros((samples, len(stepper.y)))
        x = stepper.begin(y[:lags], u[:lags])[None]
        for t in range(lags, samples):
            after, x = stepper.advance(x, u[t] + 0.05 * rng.normal(size=u.shape[1]))
            y[t] = after[0] + 0.02 * rng.normal(size=y.shape[1])
        trials.append(
            Trajectory(
                t=np.arange(samples) * model.period,
                y=y,
                u=u,
                name=f"trial {k}",
                digest=f"sha256:{k:064x}",
            )
        )
    return Dataset(tuple(trials))


@cache
def design(name: str) -> OutputTubeDesign:
    """A fading tube, and one of energy beside it for two models; levels by commands for two."""
    model = MODELS[name]()
    box = ((-1.5, 1.5), (-1.0, 1.5)) if name == "implicit_box" else None
    horizon = 40 * model.period if name in ("linear", "two_outputs") else None
    level: LevelKind = "commands" if "following" in name else "constant"
    problem = OutputTube(
        model, dataset(model, 0), dataset(model, 100), horizon=horizon, box=box, level=level
    )
    return designing.design(problem)


@cache
def _written(name: str) -> str:
    made = design(name)
    return json.dumps([made.model.document(), made.funnel.document(), made.proof])


def claim(name: str) -> tuple[Json, Json, Json]:
    """Fresh copies of the model's and the funnel's documents, and of the proof's witnesses."""
    model, funnel, proof = json.loads(_written(name))
    return model, funnel, proof


def decide(model: Json, funnel: Json, proof: Json) -> proofs.Verdict:
    """The verdict, with the digests made to fit: only the mathematics can refuse."""
    funnel["model"] = files.digest(model)
    about = {MODEL: model, FUNNEL: funnel}
    bindings = {"model": proofs.binding(MODEL, model), "funnel": proofs.binding(FUNNEL, funnel)}
    return proofs.decide(proofs.proof_document({"kind": "tube", "about": bindings}, proof), about)


def attacks(design: OutputTubeDesign, i: int, kind: str, samples: int, seed: int) -> FloatArray:
    """|o_j| over the width that level and tau give, (samples, p), with tube i's E at its level;
    0 where E is above a level that fell.

    The robot is what the innovations make of the observer. kind: `random` directions and sizes;
    `sign`, innovations that push the output error on where it is; `held`, one direction with which
    E stays at its level. The inputs switch at random inside their range.
    """
    tube, rng, stepper = design.funnel.tubes[i], np.random.default_rng(seed), Stepper(design.model)
    p, n_u = len(stepper.y), len(stepper.u)
    lags = design.funnel.settling
    u = np.zeros((lags, n_u))
    x = np.tile(stepper.begin(np.zeros((lags, p)), u), (2, 1))
    spent = 0.0
    used = np.zeros((samples, p))
    meter = None if tube.follows is None else LevelMeter(tube.follows)
    now, held = u[0], rng.normal(size=p)
    for k in range(samples):
        if rng.random() < 0.2:
            now = rng.uniform(LOW, HIGH, n_u)
        if rng.random() < 0.02:
            held = rng.normal(size=p)
        y, x = stepper.advance(x, now)
        e = {
            "random": rng.normal(size=p) * rng.random(),
            "sign": np.sign(y[0] - y[1] + 1e-12 * rng.normal(size=p)) * rng.random(p),
            "held": held,
        }[kind]
        level = tube.level * (1.0 if meter is None else meter.update(now.tolist()))
        left = max(level - tube.rho * spent, 0.0)
        part = 1.0 if kind == "held" or rng.random() < 0.3 else rng.random()
        e = e * np.sqrt(part * left / (e @ tube.R @ e))
        beside = np.zeros(p)
        if tube.peak is not None:
            beside = tube.peak.direct * tube.peak.at_most
            e /= max(1.0, float((np.abs(e) / tube.peak.at_most).max()))
        spent = tube.rho * spent + float(e @ tube.R @ e)
        if spent <= level * (1.0 + 1e-12):  # a level that falls is not kept at once
            used[k] = np.abs(y[0] + e - y[1]) / (np.sqrt(level / tube.tau) + beside)
        x[0] = x[0] + tube.L @ e
        if tube.samples is not None and k % tube.samples == tube.samples - 1:
            x[0], spent = x[1], 0.0  # the energy is over: another run
    return used
