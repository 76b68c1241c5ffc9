"""Funnels that jump into each other: what is proved is true on the guard, and forgeries are not."""

from collections.abc import Callable
from dataclasses import replace
from fractions import Fraction
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from nlsid_core import files, kernel
from nlsid_core.arrays import Json
from nlsid_core.design import Goal, compose_jumps, goal_before, integrate_nominal
from nlsid_core.dynamics import Jump, VectorField
from nlsid_core.errors import Infeasible
from nlsid_core.kernel import Rejected
from nlsid_core.proofs import check
from tests.core.kernel import mutations, oracle_hybrid
from tests.core.kernel.hybrid_claims import SLOP, falling, jump, saved
from tests.core.kernel.mutations import Case, corpus

Files = dict[str, Any]


def case(name: str) -> Case:
    return next(c for c in corpus() if (c.kind, c.name) == ("hybrid_funnel", name)).copied()


def refusal(forged: Case) -> str:
    """Why the kernel refuses it, all digests fresh; the oracle refuses it too."""
    mutations.bind_again(forged)
    contents = {name: files.encode(about) for name, about in forged.about.items()}
    with pytest.raises(Rejected) as refused:
        kernel.decide(files.encode(forged.document), lambda name: contents[name])
    assert not oracle_hybrid.agrees(forged.document, forged.about)
    return str(refused.value)


def half_width(funnel: Json) -> float:
    return float((funnel["rho"][0] / funnel["P"][0][0][0]) ** 0.5)


@pytest.mark.parametrize("share", [0.0, 0.5, 0.95, -0.95, 1.02, -1.02, 2.0])
def test_a_jump_is_proved_exactly_where_it_leads_into_the_next_funnel(
    share: float, tmp_path: Path
) -> None:
    """On the guard x = 0, so x + lifted + SLOP w is in a known interval."""
    first = saved(falling, 1.0, [0.0, 0.5, 0.85, 1.2], 0.1, tmp_path / "first")
    width = half_width(files.load_document(first.with_name("funnel.json")))
    off = np.sign(share) * (abs(share) * width - SLOP) if share else 0.0
    if abs(share) < 1:
        assert check(compose_jumps([first], [jump(1.0 + off)], tmp_path / "whole")).margin > 0
    else:
        with pytest.raises(Infeasible, match=r"jump 1: .* between \d"):
            compose_jumps([first], [jump(1.0 + off)], tmp_path / "whole")


def test_a_guard_that_is_watched_where_it_may_be_met_names_what_would_do(tmp_path: Path) -> None:
    """The guard is x: it is above 0 where the centre is more than the half-width."""
    first = saved(falling, 1.0, [0.0, 0.5, 0.85, 1.2], 0.1, tmp_path / "first")
    found = files.load_document(first.with_name("funnel.json"))
    above = [
        t for t, x, P, rho in zip(found["t"], found["x"], found["P"], found["rho"], strict=False)
        if x[0][0] > (rho / P[0][0]) ** 0.5
    ]  # fmt: skip
    late = replace(jump(1.0), start=0.85)
    with pytest.raises(
        Infeasible, match=rf"at 0\.85 s, .*; to first order it is at {above[-1]} s$"
    ):
        compose_jumps([first], [late], tmp_path / "whole")
    higher = Jump.of(lambda x: [x[0] - 0.9], lambda x: [x[0]], 1, start=0.5)
    share = max(
        (x[0][0] - 0.9) / (rho / P[0][0]) ** 0.5
        for x, P, rho in zip(found["x"], found["P"], found["rho"], strict=False)
    )
    with pytest.raises(Infeasible, match=rf"a funnel {share:.2g} times as wide would do at 0\.0 s"):
        compose_jumps([first], [higher], tmp_path / "whole")
    beyond = Jump.of(lambda x: [x[0] - 2], lambda x: [x[0]], 1, start=0.5)
    with pytest.raises(Infeasible, match="nor is it on the motion at any other knot"):
        compose_jumps([first], [beyond], tmp_path / "whole")


def test_a_goal_before_a_jump_takes_w_at_its_centre() -> None:
    field = VectorField.from_function(falling, 1, 0)
    motion = integrate_nominal(field, lambda _: np.zeros(0), t=[0.0, 0.5, 1.2], start=[1.0])
    inlet = Goal(np.ones(1), 1e4 * np.eye(1))
    alone = goal_before(jump(1.0), field, motion, inlet)
    pushed = goal_before(
        jump(1.0), lambda x, w: [falling(x)[0] + w[0]], motion, inlet, uncertain=[[-0.1, 0.1]]
    )
    assert pytest.approx(alone.P, rel=1e-6) == pushed.P


@pytest.mark.parametrize("name", ["switch", "cycle"])
def test_no_point_of_the_guard_is_taken_out_of_the_next_funnel(name: str) -> None:
    about = case(name).about
    after = about["stage2.funnel.json" if name == "switch" else "stage1.funnel.json"]
    worst, found = oracle_hybrid.worst_jump(
        about["jump1.json"], about["stage1.funnel.json"], after, 200, np.random.default_rng(0)
    )
    assert found > 1000
    assert worst == pytest.approx((SLOP / half_width(after)) ** 2, rel=0.05)


def wider_slop(about: Files) -> None:
    """What arrives may be off by more than the next funnel is wide."""
    about["jump1.json"]["uncertain"] = [[-50.0, 50.0]]


def lifted(about: Files) -> None:
    """The reset adds 0.2."""
    reset = about["jump1.json"]["reset"][0]
    row = [0, 0]
    if row not in reset["exponents"]:
        reset["exponents"].insert(0, row)
        reset["coefficients"].insert(0, 0.0)
    reset["coefficients"][reset["exponents"].index(row)] += 0.2


def guard_below(about: Files) -> None:
    """The guard is met at x = -0.5, which the funnel does not reach."""
    about["jump1.json"]["guard"] = {"exponents": [[0], [1]], "coefficients": [0.5, 1.0]}


def guard_above(about: Files) -> None:
    """The guard is met at x = 0.6, before it is watched."""
    about["jump1.json"]["guard"] = {"exponents": [[0], [1]], "coefficients": [-0.6, 1.0]}


def guard_turned(about: Files) -> None:
    """-g in the place of g."""
    guard = about["jump1.json"]["guard"]
    guard["coefficients"] = [-c for c in guard["coefficients"]]


def watched_later(about: Files) -> None:
    """From a knot at which some of the funnel is past the guard."""
    about["jump1.json"]["start"] = 0.85


def watched_between(about: Files) -> None:
    """From a time that is no knot."""
    about["jump1.json"]["start"] = 0.6


def watched_at_the_end(about: Files) -> None:
    """From the last knot on: there is no time left."""
    about["jump1.json"]["start"] = 1.2


def out_of_valid(about: Files) -> None:
    """The reset is known for x up to 0.3 only; where it is watched from, x may be more."""
    about["jump1.json"]["valid"] = [[0, -1.0, 0.3]]


def two_states(about: Files) -> None:
    """A reset of two states into a stage of one."""
    about["jump1.json"]["reset"] *= 2


def squared(about: Files) -> None:
    """The reset is not affine in w: its vertices say nothing."""
    about["jump1.json"]["reset"][0] = {
        "exponents": [[0, 2], [1, 0]], "coefficients": [0.01, 1.0]
    }  # fmt: skip


def many_products(about: Files) -> None:
    """All 127 products of seven entries of w, each times 0."""
    rows = [[0, *row] for row in product((0, 1), repeat=7)][1:]
    about["jump1.json"]["uncertain"] = [[0.0, 0.0]] * 7
    about["jump1.json"]["reset"][0] = {
        "exponents": [*rows, [1] + [0] * 7], "coefficients": [0.0] * 127 + [1.0]
    }  # fmt: skip


FORGERIES: list[tuple[Callable[[Files], None], str]] = [
    (wider_slop, "jump1: piece"),
    (lifted, "jump1: piece"),
    (guard_below, "that the guard is below 0 at 1.2 s"),
    (guard_above, "that the guard is above 0 at 0.5 s|jump1: piece"),
    (guard_turned, "that the guard is above 0 at 0.5 s"),
    (watched_later, "that the guard is above 0 at 0.85 s"),
    (watched_between, "0.6 s on, which is no knot"),
    (watched_at_the_end, "1.2 s on, which is no knot"),
    (out_of_valid, "at 0.5 s x0 is not proved to be where the guard and the reset are valid"),
    (two_states, "leads from 1 states to 2, its stages have 1 and 1"),
    (many_products, "more than 64 products of entries of w"),
    (squared, "degree above 1 in an entry of w"),
]


@pytest.mark.parametrize("name", ["switch", "cycle"])
@pytest.mark.parametrize(("forge", "reason"), FORGERIES, ids=lambda f: getattr(f, "__name__", ""))
def test_another_jump_is_refused_for_what_it_is(
    name: str, forge: Callable[[Files], None], reason: str
) -> None:
    forged = case(name)
    forge(forged.about)
    assert any(part in refusal(forged) for part in reason.split("|"))


def test_a_next_funnel_that_starts_narrower_is_refused() -> None:
    forged = case("switch")
    forged.about["stage2.funnel.json"]["rho"][0] *= 0.01  # half-width 0.005, what arrives is 0.01
    assert "stage2: piece" in refusal(forged) or "jump1: piece" in refusal(forged)


def test_a_piece_or_a_vertex_less_is_refused() -> None:
    for k in (0, -1):
        forged = case("switch")
        del forged.document["proof"]["jumps"][0]["pieces"][k]
        assert "a piece of interval" in refusal(forged)


@pytest.mark.parametrize("place", ["start", "end"])
def test_a_side_of_the_guard_needs_its_own_witness(place: str) -> None:
    forged = case("cycle")
    proof = forged.document["proof"]["jumps"][0]
    other = "end" if place == "start" else "start"
    proof[place] = proof[other]
    assert "that the guard is" in refusal(forged)


def test_a_multiplier_of_another_size_is_refused() -> None:
    for key in ("start", "end"):
        forged = case("cycle")
        for piece in forged.document["proof"]["jumps"][0]["pieces"]:
            piece["mu"][key] = [2 * value + 1 for value in piece["mu"][key]]
        assert "jump1: piece" in refusal(forged)


def test_jumps_and_stages_go_together() -> None:
    forged = case("switch")
    forged.document["claim"]["about"]["stage3"] = forged.document["claim"]["about"]["stage2"]
    assert "unknown member 'stage3'" in refusal(forged)
    forged = case("switch")
    del forged.document["claim"]["about"]["stage2"]  # then the jump leads into stage1: not so
    assert "jump1: piece" in refusal(forged)
    forged = case("cycle")
    forged.document["proof"]["jumps"] *= 2
    assert "is missing" in refusal(forged)
    forged = case("cycle")
    forged.document["proof"]["jumps"] = []
    assert "should be a list of 1 to 50 entries" in refusal(forged)


def test_vertices_are_counted_before_they_are_listed() -> None:
    """32 entries of w have 2^32 vertices."""
    forged = case("switch")
    jump = forged.about["jump1.json"]
    jump["uncertain"] = [[-1.0, 1.0]] * 32
    jump["reset"] = [{"exponents": [[1] + [0] * 32], "coefficients": [1.0]}]
    mutations.bind_again(forged)
    contents = {name: files.encode(about) for name, about in forged.about.items()}
    with pytest.raises(Rejected, match="jump1: more than 100000 intervals times vertices"):
        kernel.decide(files.encode(forged.document), contents.__getitem__)


def test_a_stage_with_a_hold_is_refused() -> None:
    forged = case("cycle")
    forged.about["stage1.proof.json"]["claim"]["hold"] = 0.01
    assert "an input that is held into the next stage is not covered" in refusal(forged)


def test_what_is_said_names_the_times_and_what_is_assumed() -> None:
    for name, said in (("switch", "the last is a funnel: "), ("cycle", "so for ever")):
        contents = {key: files.encode(about) for key, about in case(name).about.items()}
        verdict = kernel.decide(files.encode(case(name).document), contents.__getitem__)
        assert "the guard is first 0 in stage1 between 0.5 and 1.2 s; " in verdict.statement
        assert said in verdict.statement
        assert "jump1: w0 in [-1, 1]" in verdict.assumptions
        assert any("first 0 at or after 0.5 s of the clock" in a for a in verdict.assumptions)
        assert verdict.margin == min(
            Fraction(about["proof"]["margin"]) for key, about in case(name).about.items()
            if key.endswith("proof.json")
        )  # fmt: skip
