"""Changes of a model or of its proof of stability, each of which makes the proof wrong."""

from collections.abc import Callable

import numpy as np

from nlsid_core.arrays import Json


def _lower_half(proof: Json) -> None:
    proof["multipliers"] = proof["multipliers"]["parts"][0]


CHANGES: dict[str, tuple[str, Callable[[Json, Json], None], str]] = {
    "unstable": ("linear", lambda m, _: m.update(a=[1.9, -0.85, 0.0]), "decrease"),
    "negative P": ("linear", lambda _, p: p.update(P=(-np.array(p["P"])).tolist()), "P is not"),
    "triangular P": ("linear", lambda _, p: p.update(P=np.triu(p["P"]).tolist()), "symmetric"),
    "small P": ("linear", lambda _, p: p.update(P=[[1.0]]), "shape"),
    "multipliers": ("linear", lambda _, p: p.update(multipliers={"N": []}), "no multipliers"),
    "stranger": ("linear", lambda _, p: p.update(lower=1.0), "unknown member"),
    "no multipliers": ("quadratic", lambda _, p: p.pop("multipliers"), "needs multipliers"),
    "wider box": ("moving_lags", lambda m, _: m.update(u_range=[[-8.0, 20.0]]), "decrease"),
    "empty box": ("quadratic", lambda m, _: m.update(u_range=[[1.0, 1.0]]), "not empty"),
    "no scale": ("quadratic", lambda m, _: m.update(u_scale=[0.0]), "positive"),
    "other range": ("quadratic", lambda m, _: m.update(on_out_of_range="ignore"), "clip, refuse"),
    "half the box": ("split", lambda _, p: _lower_half(p), "decrease"),
    "no such variable": ("split", lambda _, p: p["multipliers"].update(split=2), "from 0 to 1"),
    "three parts": (
        "split",
        lambda _, p: p["multipliers"].update(parts=[p["multipliers"]["parts"][0]] * 3),
        "2 to 2",
    ),
    "exchanged parts": ("split", lambda _, p: p["multipliers"]["parts"].reverse(), "decrease"),
    "a higher low end": (
        "ends",
        lambda _, p: p["multipliers"]["ends"].update(low=p["multipliers"]["ends"]["low"] + 1e-4),
        "the low end",
    ),
    "a lower high end": (
        "ends",
        lambda _, p: p["multipliers"]["ends"].update(high=p["multipliers"]["ends"]["high"] - 1e-4),
        "the high end",
    ),
    "ends of a wider box": ("ends", lambda m, _: m.update(u_range=[[-8.0, 20.0]]), "end of the"),
    "a negative weight": (
        "ends",
        lambda _, p: p["multipliers"]["ends"].update(
            low_weights=[-1.0] * len(p["multipliers"]["ends"]["low_weights"])
        ),
        "0 or more",
    ),
    "ends of moving lags": (
        "split",
        lambda _, p: p.update(multipliers={"N": [[1.0], [0.0]], "ends": {}}),
        "constant factors",
    ),
    "ends of nothing": ("monotone", lambda _, p: p["multipliers"].update(ends={}), "multiplier N"),
    "leaf and node": ("split", lambda _, p: p["multipliers"].update(N=[[1.0]]), "a multiplier N"),
    "singular": (
        "constant",
        lambda m, _: m["G"][0].update(coefficients=[[[1.0, 0.5], [2.0, 1.0]]]),
        "decrease",
    ),
    "slower": (
        "constant",
        lambda m, _: m["G"][1]["coefficients"][0][1].__setitem__(1, -1.05),
        "decrease",
    ),
    "ray": ("monotone", lambda _, p: p["multipliers"]["N"][1].__setitem__(0, 1e-9), r"\(T, 0"),
    "negative T": (
        "monotone",
        lambda _, p: p["multipliers"].update(N=(-np.array(p["multipliers"]["N"])).tolist()),
        r"\(T, 0",
    ),
    "pole outside": ("cascade", lambda m, _: m.update(a1=[1.9, -1.05]), "decrease"),
    "pole on the circle": ("cascade", lambda m, _: m.update(a2=[1.0]), "decrease"),
    "closer knots": ("cascade", lambda m, _: m["f"].update(spacing=0.05), "decrease"),
    "steeper map": (
        "network",
        lambda m, _: m["maps"][0]["values"].__setitem__(2, 1.25),
        "decrease",
    ),
    "rising cap": ("network", lambda m, _: m["maps"][1]["values"].__setitem__(2, 3.0), "decrease"),
    "a loop of maps": ("network", lambda m, _: m["into"][0].__setitem__(1, 0.1), "earlier maps"),
    "knots that fall": ("network", lambda m, _: m["maps"][2]["knots"].reverse(), "ascending"),
    "one knot": ("network", lambda m, _: m["maps"][2].update(knots=[0.0], values=[0.0]), "2 knots"),
    "fewer maps": ("network", lambda m, _: m["maps"].pop(), "shape"),
    "no spacing": ("cascade", lambda m, _: m["f"].update(spacing=0.0), "spacing"),
    "stronger": ("cascade", lambda m, _: m["b1"][1].__setitem__(0, 50.0), "decrease"),
    "ragged": ("cascade", lambda m, _: m["b1"][1].append(0.0), "equal lengths"),
    "another kind": ("linear", lambda m, _: m.update(kind="state_map"), "known: "),
    "a note": ("linear", lambda m, _: m.update(note="stable"), "unknown member 'note'"),
    "no period": ("linear", lambda m, _: m.update(period=0.0), "period"),
    "a name on two lines": ("linear", lambda m, _: m["y"].update(name="a\nPROVED"), "control"),
}
