"""Designs of sampled funnels with one thing made better than it is, and all digests made to fit."""

import copy
from dataclasses import replace

import numpy as np

from nlsid_core.design.sampled.design import TrackingDesign
from tests.tracked import designed, resigned


def forged(design: TrackingDesign, what: str) -> TrackingDesign:
    """The design with one thing made better than it is, and all digests made to fit."""
    funnel = design.funnel
    if what == "tube cut by 2 %":
        tube = funnel.tube.copy()
        tube[1:] *= 0.98
        return resigned(design, funnel=replace(funnel, tube=tube))
    if what == "one level of the tube cut by 2 %":
        tube = funnel.tube.copy()
        tube[7] *= 0.98
        return resigned(design, funnel=replace(funnel, tube=tube))
    if what == "goal 2 % below what is reached":
        inlet = funnel.inlet.copy()
        inlet[-1] = 0.98 * design.proof["steps"][-1]["inlet"]["reach"]
        return resigned(design, funnel=replace(funnel, inlet=inlet))
    if what == "inlet raised by 2 %":
        return resigned(design, funnel=replace(funnel, inlet=1.02 * funnel.inlet))
    if what == "levels and reaches cut by 2 %":
        proof = copy.deepcopy(design.proof)
        for entry in proof["steps"]:
            for chain in ("tube", "inlet"):
                entry[chain]["reach"] *= 0.98
        tube = funnel.tube * np.r_[1.0, np.full(len(funnel.tube) - 1, 0.98)]
        forged = replace(design, certificate=design.certificate | {"proof": proof})
        return resigned(forged, funnel=replace(funnel, tube=tube))
    if what == "assumption made smaller":
        smaller = replace(funnel.assumption, bound=0.9 * funnel.assumption.bound)
        return resigned(design, funnel=replace(funnel, assumption=smaller))
    if what == "safety factor below one":
        smaller = replace(funnel.assumption, safety_factor=0.5)
        return resigned(design, funnel=replace(funnel, assumption=smaller))
    if what == "commissioning runs are the fitting bags":
        borrowed = replace(funnel.assumption, measured_on=design.model.bags)
        return resigned(design, funnel=replace(funnel, assumption=borrowed))
    if what == "no commissioning runs":
        unmeasured = replace(funnel.assumption, measured_on=())
        return resigned(design, funnel=replace(funnel, assumption=unmeasured))
    if what == "half-widths cut by a millionth":
        return resigned(design, funnel=replace(funnel, half_widths=funnel.half_widths / 1.000001))
    if what == "half-widths cut by an ulp at the end":
        widths = funnel.half_widths.copy()
        widths[-1, 1] = np.nextafter(widths[-1, 1], 0.0)
        return resigned(design, funnel=replace(funnel, half_widths=widths))
    if what == "another nominal":
        return resigned(design, policy=designed(goal=0.3).policy)
    if what == "gain 3 % smaller":
        return resigned(design, policy=replace(design.policy, K=0.97 * design.policy.K))
    if what == "another model":
        heavier = replace(design.model, coefficients=1.002 * design.model.coefficients)
        return resigned(design, model=heavier)
    if what == "narrower data box":
        return resigned(design, model=replace(design.model, x_range=0.5 * design.model.x_range))
    if what == "weaker drive":
        return resigned(design, model=replace(design.model, u_range=0.5 * design.model.u_range))
    proof = copy.deepcopy(design.proof)
    taken = proof["steps"][5]
    if what == "a factor's entry changed":
        taken["tube"]["squares"]["factors"][0][0][0] *= 2
    elif what == "a multiplier left out":
        taken["tube"]["ball"]["squares"]["factors"] = [[]]
    elif what == "a multiplier twice as large":
        taken["tube"]["ball"]["squares"]["unit"] -= 1
    elif what == "T shrunk":
        taken["T"] = (0.5 * np.array(taken["T"])).tolist()
    elif what == "T with a zero on its diagonal":
        taken["T"][1][1] = 0.0
    elif what == "curvature made smaller":
        taken["curvature"][2] *= 0.999
    elif what == "curvature left out":
        taken["curvature"].pop()
    elif what == "curvature negative":
        taken["curvature"][2] *= -1.0
    elif what == "kappa below one":
        taken["kappa"] = 0.999
    elif what == "two steps exchanged":
        proof["steps"][5], proof["steps"][6] = proof["steps"][6], proof["steps"][5]
    elif what == "the chains exchanged":
        taken["tube"], taken["inlet"] = taken["inlet"], taken["tube"]
    elif what == "reach negative":
        taken["tube"]["reach"] *= -1.0
    elif what == "a member more":
        taken["more"] = 1
    else:
        raise ValueError(what)
    return replace(design, certificate=design.certificate | {"proof": proof})


# What contradicts what was measured: true claims, under assumptions that nobody should make.
CONTRADICTIONS = [
    "assumption made smaller",
    "safety factor below one",
    "commissioning runs are the fitting bags",
    "no commissioning runs",
]
FORGERIES = [
    "tube cut by 2 %",
    "one level of the tube cut by 2 %",
    "goal 2 % below what is reached",
    "inlet raised by 2 %",
    "levels and reaches cut by 2 %",
    "another nominal",
    "gain 3 % smaller",
    "another model",
    "narrower data box",
    "weaker drive",
    "a factor's entry changed",
    "a multiplier left out",
    "a multiplier twice as large",
    "T shrunk",
    "T with a zero on its diagonal",
    "curvature made smaller",
    "curvature left out",
    "curvature negative",
    "kappa below one",
    "two steps exchanged",
    "the chains exchanged",
    "reach negative",
    "a member more",
    "half-widths cut by a millionth",
    "half-widths cut by an ulp at the end",
]
