"""What funnels and policies of every kind have in common: sizes, widths, one `load` each."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from nlsid_core import files
from nlsid_core.design import OutputTubeDesign
from nlsid_core.documents import load
from nlsid_core.errors import DocumentError
from nlsid_core.funnels.continuous import ContinuousFunnel
from nlsid_core.funnels.protocol import Funnel
from nlsid_core.funnels.sampled import SampledFunnel
from nlsid_core.policies.protocol import AnyPolicy, Policy
from tests.continuous_stage import stage
from tests.tracked import designed


def pairs() -> list[tuple[AnyPolicy, SampledFunnel | ContinuousFunnel]]:
    """One of each kind that holds a state."""
    sampled, (_, policy, funnel) = designed(), stage()
    return [(sampled.policy, sampled.funnel), (policy, funnel)]


def test_every_kind_answers_the_same_questions(design: OutputTubeDesign) -> None:
    for policy, funnel in pairs():
        common: Funnel = funnel
        plan: Any = policy
        for when in (0, common.last):
            widths = common.widths(when)
            assert common.size(when, np.zeros(len(widths))) <= 1e-12
            assert not common.size(when, np.full(len(widths), np.nan)) <= 1.0
            for i, width in enumerate(widths):
                inside = np.zeros(len(widths))
                inside[i] = width
                assert common.size(when, 1.001 * inside) > 1.0, "beyond its width on an axis"
        assert common.made_for == (plan.made_for, files.digest(plan.document()))
        _covers(plan, len(common.widths(0)))
        assert plan.last <= common.last
    assert design.policy is not None
    tube, planned = design.funnel, design.policy.plan(design.model)
    assert tube.made_for == (design.policy.made_for, files.digest(design.policy.document()))
    _covers(planned, len(design.model))
    assert planned.last <= tube.last
    assert tube.start_size(np.zeros(len(design.model))) == 0.0
    assert not tube.start_size(np.full(len(design.model), np.nan)) <= 1.0


def _covers(plan: Policy, n: int) -> None:
    low, high = plan.covers(0, np.zeros(n))
    assert np.all(low <= high)


def test_one_load_reads_every_kind_and_refuses_what_is_none(
    design: OutputTubeDesign, tmp_path: Path
) -> None:
    for policy, funnel in [*pairs(), (design.policy, design.funnel)]:
        assert policy is not None
        files.write_document(tmp_path / "policy.json", policy.document())
        files.write_document(tmp_path / "funnel.json", funnel.document())
        for name, noun in (("policy", policy), ("funnel", funnel)):
            read = load(tmp_path / f"{name}.json")
            assert (type(read), read.document()) == (type(noun), noun.document())
    files.write_document(tmp_path / "funnel.json", funnel.document() | {"kind": "round"})
    with pytest.raises(DocumentError, match="of kind 'round' is known"):
        load(tmp_path / "funnel.json")
