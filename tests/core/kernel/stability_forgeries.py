"""Changes of a model or of its proof of stability, each of which makes the proof wrong."""

from collections.abc import Callable

import numpy as np

from nlsid_core.arrays import Json


def _lower_half(proof: Json) -> None:
    proof["multipliers"] = proof["multipliers"]["parts"][0]


CHANGES: dict[str, tuple[str, Callable[[Json, Json], None], str]] = {
    "unstable": ("linear", lambda m, _: m.update(a=[1.9, -0.85, 0.0]), "not_definite"),
    "negative P": ("linear", lambda _, p: p.update(P=(-np.array(p["P"])).tolist()), "not_definite"),
    "triangular P": ("linear", lambda _, p: p.update(P=np.triu(p["P"]).tolist()), "not_definite"),
    "small P": ("linear", lambda _, p: p.update(P=[[1.0]]), "malformed"),
    "multipliers": ("linear", lambda _, p: p.update(multipliers={"N": []}), "malformed"),
    "stranger": ("linear", lambda _, p: p.update(lower=1.0), "malformed"),
    "no multipliers": ("quadratic", lambda _, p: p.pop("multipliers"), "malformed"),
    "wider box": ("moving_lags", lambda m, _: m.update(u_range=[[-8.0, 20.0]]), "not_definite"),
    "empty box": ("quadratic", lambda m, _: m.update(u_range=[[1.0, 1.0]]), "malformed"),
    "no scale": ("quadratic", lambda m, _: m.update(u_scale=[0.0]), "malformed"),
    "other range": ("quadratic", lambda m, _: m.update(on_out_of_range="ignore"), "malformed"),
    "half the box": ("split", lambda _, p: _lower_half(p), "not_definite"),
    "no such variable": ("split", lambda _, p: p["multipliers"].update(split=2), "malformed"),
    "three parts": (
        "split",
        lambda _, p: p["multipliers"].update(parts=[p["multipliers"]["parts"][0]] * 3),
        "malformed",
    ),
    "exchanged parts": ("split", lambda _, p: p["multipliers"]["parts"].reverse(), "not_definite"),
    "ends": (
        "split",
        lambda _, p: p.update(multipliers={"N": [[1.0], [0.0]], "ends": {}}),
        "left",
    ),
    "split slopes": (
        "network",
        lambda _, p: p.update(multipliers={"split": 0, "parts": [p["multipliers"]] * 2}),
        "malformed",
    ),
    "leaf and node": ("split", lambda _, p: p["multipliers"].update(N=[[1.0]]), "malformed"),
    "singular": (
        "constant",
        lambda m, _: m["G"][0].update(coefficients=[[[1.0, 0.5], [2.0, 1.0]]]),
        "not_definite",
    ),
    "slower": (
        "constant",
        lambda m, _: m["G"][1]["coefficients"][0][1].__setitem__(1, -1.05),
        "not_definite",
    ),
    "ray": ("monotone", lambda _, p: p["multipliers"]["N"][1].__setitem__(0, 1e-9), "not_below"),
    "negative T": (
        "monotone",
        lambda _, p: p["multipliers"].update(N=(-np.array(p["multipliers"]["N"])).tolist()),
        "not_below",
    ),
    "pole outside": ("cascade", lambda m, _: m.update(a1=[1.9, -1.05]), "not_definite"),
    "pole on the circle": ("cascade", lambda m, _: m.update(a2=[1.0]), "not_definite"),
    "closer knots": ("cascade", lambda m, _: m["f"].update(spacing=0.05), "not_definite"),
    "steeper map": (
        "network",
        lambda m, _: m["maps"][0]["values"].__setitem__(2, 1.25),
        "not_definite",
    ),
    "rising cap": (
        "network",
        lambda m, _: m["maps"][1]["values"].__setitem__(2, 3.0),
        "not_definite",
    ),
    "a loop of maps": ("network", lambda m, _: m["into"][0].__setitem__(1, 0.1), "malformed"),
    "knots that fall": ("network", lambda m, _: m["maps"][2]["knots"].reverse(), "malformed"),
    "one knot": (
        "network",
        lambda m, _: m["maps"][2].update(knots=[0.0], values=[0.0]),
        "malformed",
    ),
    "fewer maps": ("network", lambda m, _: m["maps"].pop(), "malformed"),
    "no spacing": ("cascade", lambda m, _: m["f"].update(spacing=0.0), "malformed"),
    "stronger": ("cascade", lambda m, _: m["b1"][1].__setitem__(0, 50.0), "not_definite"),
    "ragged": ("cascade", lambda m, _: m["b1"][1].append(0.0), "malformed"),
    "another kind": ("linear", lambda m, _: m.update(kind="state_map"), "malformed"),
    "a note": ("linear", lambda m, _: m.update(note="stable"), "malformed"),
    "no period": ("linear", lambda m, _: m.update(period=0.0), "malformed"),
    "a name on two lines": ("linear", lambda m, _: m["y"].update(name="a\nPROVED"), "malformed"),
}
