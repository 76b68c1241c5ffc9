"""Files of a sampled funnel with one thing made better than it is, and why it is refused."""

import math

from tests.edits import Edit, both, changed, exchanged, put, scaled, without
from tests.funnel_files import FUNNEL, MODEL, POLICY, PROOF, Files
from tests.tracked import designed, pendulum

STEPS = f"{PROOF} proof steps"
STEP = f"{STEPS} 5"
LATER = changed(f"{FUNNEL} tube", lambda tube: [tube[0], *(0.98 * r for r in tube[1:])])


def _another_nominal(files: Files) -> None:
    files[POLICY] = designed(goal=0.3).policy.document()


def _goal_below_what_is_reached(files: Files) -> None:
    reach = files[PROOF]["proof"]["steps"][-1]["inlet"]["reach"]
    files[FUNNEL]["inlet"][-1] = 0.98 * reach


# What contradicts what was measured: true claims, under assumptions that nobody should make.
CONTRADICTIONS: dict[str, Edit] = {
    "assumption made smaller": scaled(f"{FUNNEL} assumption bound", 0.9),
    "safety factor below one": put(f"{FUNNEL} assumption safety_factor", 0.5),
    "commissioning runs are the fitting bags": put(
        f"{FUNNEL} assumption measured_on", pendulum().document()["bags"]
    ),
    "no commissioning runs": put(f"{FUNNEL} assumption measured_on", []),
}
FORGERIES: dict[str, tuple[Edit, str]] = {
    "tube cut by 2 %": (LATER, "not_below"),
    "one level of the tube cut by 2 %": (scaled(f"{FUNNEL} tube 7", 0.98), "not_below"),
    "goal 2 % below what is reached": (_goal_below_what_is_reached, "not_below"),
    "inlet raised by 2 %": (scaled(f"{FUNNEL} inlet", 1.02), "not_valid"),
    "levels and reaches cut by 2 %": (
        both(
            scaled(f"{STEPS} * tube reach", 0.98),
            scaled(f"{STEPS} * inlet reach", 0.98),
            LATER,
        ),
        "not_below",
    ),
    "another nominal": (_another_nominal, "not_definite"),
    "gain 3 % smaller": (scaled(f"{POLICY} K", 0.97), "not_definite"),
    "another model": (scaled(f"{MODEL} coefficients", 1.002), "not_definite"),
    "narrower data box": (scaled(f"{MODEL} x_range", 0.5), "not_valid"),
    "weaker drive": (scaled(f"{MODEL} u_range", 0.5), "not_valid"),
    "a factor's entry changed": (scaled(f"{STEP} tube squares factors 0 0 0", 2), "not_positive"),
    "a multiplier left out": (put(f"{STEP} tube ball squares factors", [[]]), "not_positive"),
    "a multiplier twice as large": (
        changed(f"{STEP} tube ball squares unit", lambda n: n - 1),
        "not_positive",
    ),
    "T shrunk": (scaled(f"{STEP} T", 0.5), "not_definite"),
    "T with a zero on its diagonal": (put(f"{STEP} T 1 1", 0.0), "malformed"),
    "curvature made smaller": (scaled(f"{STEP} curvature 2", 0.999), "not_definite"),
    "curvature left out": (without(f"{STEP} curvature -1"), "not_covered"),
    "curvature negative": (scaled(f"{STEP} curvature 2", -1.0), "not_below"),
    "kappa below one": (put(f"{STEP} kappa", 0.999), "not_definite"),
    "two steps exchanged": (exchanged(STEP, f"{STEPS} 6"), "not_definite"),
    "the chains exchanged": (exchanged(f"{STEP} tube", f"{STEP} inlet"), "not_below"),
    "reach negative": (scaled(f"{STEP} tube reach", -1.0), "not_below"),
    "no box of the data's states": (without(f"{MODEL} x_range"), "malformed"),
    "no box of the data's inputs": (without(f"{MODEL} u_range"), "malformed"),
    "a power that nobody would live to see": (
        put(f"{MODEL} exponents -1", [15, 15, 15]),
        "too_large",
    ),
    "a step less": (without(f"{STEPS} 3"), "malformed"),
    "a member more": (put(f"{STEP} more", 1), "malformed"),
    "half-widths cut by a millionth": (scaled(f"{FUNNEL} half_widths", 1 / 1.000001), "not_valid"),
    "half-widths cut by an ulp at the end": (
        changed(f"{FUNNEL} half_widths -1 1", lambda width: math.nextafter(width, 0.0)),
        "not_valid",
    ),
}
