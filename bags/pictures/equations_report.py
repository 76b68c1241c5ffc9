"""The chapter of a design page that shows a funnel of given equations."""

from fractions import Fraction
from html import escape
from typing import Any

from bags.designs import documents
from nlsid_core.arrays import Json
from nlsid_core.designs import AnyDesign
from nlsid_core.dynamics import VectorField
from nlsid_core.funnels.continuous import ContinuousFunnel
from nlsid_core.kernel import text
from nlsid_core.policies.continuous import ContinuousPolicy

MOST_TERMS = 12  # of an equation that is printed


def equations_chapter(design: AnyDesign) -> str:
    """Half-widths, equations and limits; empty if the funnel is of another kind."""
    field, policy, funnel = design.model, design.policy, design.funnel
    if not isinstance(funnel, ContinuousFunnel) or design.parts:
        return ""
    lines = [
        "x are the states and u the inputs, counted from 0, in the order and in the units of the "
        "equations below; the files have no other names for them",
        *_equations(field),
        *_bounds(field, policy, design.claim),
    ]
    said = "".join(f"<li>{escape(line)}</li>" for line in lines)
    return f"{_widths(funnel)}<ul>{said}</ul>"


def _widths(funnel: ContinuousFunnel) -> str:
    times = (funnel.t0, (funnel.t0 + funnel.tf) / 2, funnel.tf)
    head = "".join(f"<th>at {t:.4g} s</th>" for t in times)
    half, nominal = ([part(t) for t in times] for part in (funnel.widths, funnel.nominal))
    rows = "".join(
        f"<tr><td>x{i}</td>"
        + "".join(
            f"<td>{x[i]:.4g} ± {text.above(Fraction(w[i]))}</td>"
            for x, w in zip(nominal, half, strict=True)
        )
        + "</tr>"
        for i in range(funnel.n)
    )
    return (
        f"<table><thead><tr><th>state</th>{head}</tr></thead><tbody>{rows}</tbody></table>"
        '<p class="note">Nominal ± half-width of the funnel, this rounded up; one state can be '
        "so far out only if the others are not.</p>"
    )


def _equations(field: VectorField) -> list[str]:
    lines = []
    if len(field.pieces) > 1:
        lines.append(
            f"the equations of the first of {len(field.pieces)} time spans; the others are in "
            f"{documents.VECTOR_FIELD}"
        )
    for i, equation in enumerate(field.pieces[0]):
        terms = [(e, float(c)) for e, c in equation.terms()]
        shown = [_term(field.names, e, c) for e, c in terms[:MOST_TERMS]]
        if len(terms) > len(shown):
            shown.append(f"… ({len(terms)} terms)")
        lines.append(f"dx{i}/dt = {' + '.join(shown) or '0'}".replace("+ -", "- "))
    if field.expansion:
        lines.append(f"expanded: {field.expansion}")
    return lines


def _term(names: tuple[str, ...], exponents: Any, coefficient: float) -> str:
    powers = [(name, int(e)) for name, e in zip(names, exponents, strict=True) if e]
    factors = [name if e == 1 else f"{name}^{e}" for name, e in powers]
    size = f"{coefficient:.4g}"
    return " ".join(factors if factors and size == "1" else [size, *factors])


def _bounds(field: VectorField, policy: ContinuousPolicy, claim: Json) -> list[str]:
    names = field.names[1:]
    limits = [f"u{int(j)} in [{low:g}, {high:g}]" for j, low, high in policy.limits.tolist()]
    pushes = [f"w{j} in [{low:g}, {high:g}]" for j, (low, high) in enumerate(field.uncertain)]
    inside = [f"{names[j]} in [{low:g}, {high:g}]" for j, low, high in field.validity(0)]
    planned = zip(policy.planned.min(axis=0), policy.planned.max(axis=0), strict=True)
    plan = [f"u{j} in [{low:.4g}, {high:.4g}]" for j, (low, high) in enumerate(planned)]
    wrong = [f"x{i} to {e:g}" for i, e in enumerate(claim.get("error", [])) if e]
    return [
        f"inputs are clipped to: {', '.join(limits) or 'nothing (the proof needs no limits)'}",
        f"inputs of the motion itself, at its knots: {', '.join(plan)}",
        f"what may vary at every time: {', '.join(pushes) or 'nothing (no w)'}",
        *(
            [f"where the equations hold, which the funnel stays in: {', '.join(inside)}"]
            if inside
            else []
        ),
        f"hold: an input is at most {claim['hold']:g} s old"
        if "hold" in claim
        else "hold: none; the policy is applied continuously",
        *([f"measured within: {', '.join(wrong)}"] if wrong else []),
    ]
