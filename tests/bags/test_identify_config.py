"""What a configuration may not say, with what is allowed; and the page that lists every key."""

import re
from pathlib import Path
from typing import Any, get_type_hints

import pytest
import yaml
from pydantic import TypeAdapter

from bags.chain.config import Config, load_config
from bags.chain.sections import Section, sections_in
from bags.chain.shipped import config_file
from bags.chain.templates import TEMPLATES, option_texts
from bags.chain.tracking_config import TrackingConfig
from bags.samples import f1tenth
from docs.site import configuration
from nlsid_core.errors import DataError
from nlsid_core.identification import (
    METHODS,
    Degrees,
    FilterMapFilter,
    LeastSquares,
    Network,
    Polynomial,
    Rie,
    Rse,
    Sem,
)
from tests.house.sources import ROOT
from tests.identified_bags import write_config
from tests.verbs import nlsid


@pytest.mark.parametrize(
    ("section", "expected"),
    [
        ({"lags": 4}, Polynomial(4)),
        (
            {"model": "state_affine", "lags": 2, "input_range": [-1, 1.5], "delays": [1, 2]},
            Polynomial(2, (1, 2), input_range=((-1.0, 1.5),)),
        ),
        (
            {
                "model": "state_affine",
                "lags": 2,
                "input_range": [[0, 1], [2, 3]],
                "on_out_of_range": "refuse",
            },
            Polynomial(2, input_range=((0.0, 1.0), (2.0, 3.0)), on_out_of_range="refuse"),
        ),
        (
            {"model": "block_cascade", "orders": [2, 0], "intervals": 8},
            Network(FilterMapFilter((2, 0), intervals=8)),
        ),
        ({"model": "monotone", "lags": 3, "left_degree": 1}, Polynomial(3, set="3.8")),
        (
            {
                "model": "implicit",
                "set": "2.13",
                "delays": [1],
                "output_range": [-1, 1],
                "input_range": [0, 2],
            },
            Polynomial(1, (1,), Degrees(left=3), ((0.0, 2.0),), ((-1.0, 1.0),), set="2.13"),
        ),
        ({"model": "linear_states"}, Polynomial(1, (1,), set="2.19")),
    ],
)
def test_each_section_says_a_model_class(
    tmp_path: Path, section: dict[str, Any], expected: object
) -> None:
    inputs = sum(isinstance(pair, list) for pair in section.get("input_range", ())) or 1
    config = load_config(write_config(tmp_path / "robot.yaml", section, inputs=inputs))
    assert config.identification.model_class == expected


@pytest.mark.parametrize(
    ("section", "expected"),
    [
        ({"lags": 4}, Rse()),
        ({"lags": 4, "method": "least_squares"}, LeastSquares()),
        ({"lags": 4, "iterations": 7}, Rse(iterations=7)),
        (
            {
                "model": "state_affine",
                "lags": 2,
                "method": "sem",
                "certified": True,
                "iterations": 7,
            },
            Sem(iterations=7, certified=True),
        ),
        (
            {"model": "monotone", "lags": 2, "accept_untested_repeats": True},
            Rie(accept_untested_repeats=True),
        ),
        ({"model": "monotone", "lags": 2, "method": "sem"}, Sem()),
        ({"model": "cells", "method": "sem", "iterations": 3}, Sem(3, certified=True)),
    ],
)
def test_each_section_says_a_method_with_its_options(
    tmp_path: Path, section: dict[str, Any], expected: object
) -> None:
    config = load_config(write_config(tmp_path / "robot.yaml", section))
    assert config.identification.method == expected


def test_transient_and_unproved_models_are_options_of_every_section(tmp_path: Path) -> None:
    section = {"lags": 2, "transient": 5, "allow_unproved": True}
    config = load_config(write_config(tmp_path / "robot.yaml", section)).identification
    assert (config.search.transient, config.search.allow_unproved) == (5, True)
    plain = load_config(write_config(tmp_path / "robot.yaml", {"lags": 2})).identification
    assert (plain.search.transient, plain.search.allow_unproved) == (0, False)


@pytest.mark.parametrize(
    ("section", "reason"),
    [
        (
            {"model": "wiener", "lags": 2},
            "identification: there is no such model; there are: linear, state_affine, monotone",
        ),
        (
            {"lags": 2, "orders": [1, 2]},
            r"identification.orders: there is no such key; there are: model, .*\(found \[1, 2\]",
        ),
        (
            {"lags": 2, "method": "magic"},
            r"identification.method: should be 'rse', .* or 'sem' \(found 'magic'\)",
        ),
        (
            {"model": "monotone", "lags": 2, "method": "rse"},
            r"identification.method: is not for this model class: 'rie', .* \(found 'rse'\)",
        ),
        (
            {"lags": 2, "iterations": 0},
            r"identification.iterations: should be a whole number from 1 to 1000 \(found 0\)",
        ),
        ({"lags": 2, "iterations": 2.5}, r"iterations: Input should be a valid integer"),
        (
            {"lags": 2, "iterations": 4, "method": "least_squares"},
            r"identification.iterations: there is no such key; there are: model, lags, method",
        ),
        ({"lags": 2, "transient": -1}, r"identification.transient: Input should be greater than"),
        ({"lags": 2, "allow_unproved": "yes"}, r"allow_unproved: Input should be a valid boolean"),
        ({"model": "block_cascade", "orders": [1, 2.5]}, r"orders.1: Input should be a valid int"),
        ({}, "identification.lags: Field required$"),
        ([4], "identification: should be keys and values"),
        ({"model": ["linear"]}, "identification: there is no such model"),
        ({"lags": 2, "seed": 1}, "identification.seed: there is no such key"),
        (
            {"model": "state_affine", "lags": 2, "lagged_degree": 2, "certified": True},
            r"identification.certified: should be false for this model class \(found True\)",
        ),
        ({"model": "cells", "certified": False}, "certified: should be true for this model class"),
        (
            {"model": "state_affine", "lags": 2, "delays": [3]},
            r"identification.delays: should be one or more whole numbers from 0 to 2 \(found \[3\]",
        ),
        (
            {"model": "state_affine", "lags": 2, "on_out_of_range": "warn"},
            r"on_out_of_range: Input should be 'clip' or 'refuse' \(found 'warn'\)",
        ),
        ({"model": "state_affine", "lags": 2, "input_range": [0, 1, 2]}, "at most 2 items"),
        ({"model": "block_cascade", "orders": [0, 0]}, "not both zero"),
        ({"model": "block_cascade", "phases": 9}, "phases: should be a whole number from 1 to 4"),
        (
            {"model": "monotone", "lags": 2, "left_degree": 2},
            r"left_degree: should be one of 1, 3, 5, 7, 9 \(found 2\)",
        ),
        ({"model": "implicit", "set": 2.13}, r"set: Input should be '2.11', .* \(found 2.13\)"),
        ({"model": "implicit", "set": "2.13", "lags": 2}, "set 2.13 is for 1 lag"),
        ({"model": "implicit", "past_degree": 3}, "needs ranges in set 2.11"),
        ({"model": "implicit", "lagged_degree": 1}, "stable in ranges only"),
        ({"model": "linear_states", "lags": 1}, "identification.lags: there is no such key"),
    ],
)
def test_a_wrong_identification_names_key_value_and_what_is_allowed(
    tmp_path: Path, section: Any, reason: str
) -> None:
    with pytest.raises(DataError, match=reason):
        load_config(write_config(tmp_path / "robot.yaml", section))


def test_every_wrong_key_is_said_at_once_with_the_nearest_and_its_unit(tmp_path: Path) -> None:
    """Two unknown keys and two wrong values in three sections, in one message."""
    sections: dict[str, Any] = {
        "grid": {"perod": 0.01, "period": -1.0, "max_gap": 0.05},
        "funnel": {"reaction_time": "soon"},
        "monitor": {"nominl": "profile"},
    }
    path = write_config(tmp_path / "robot.yaml", {"lag": 4, "transient": -1}, **sections)
    with pytest.raises(DataError) as caught:
        load_config(path)
    said = str(caught.value).splitlines()
    for line in (
        r"grid\.perod: there is no such key; there are: period, max_gap, .*; did you mean 'period'",
        r"grid\.period: Input should be greater than 0, in s \(found -1\.0\)",
        r"funnel\.reaction_time: Input should be a valid number, in s \(found 'soon'\)",
        r"monitor\.nominl: there is no such key; .*; did you mean 'nominal'\?",
        r"identification\.lags: Field required",
        r"identification\.transient: Input should be greater than or equal to 0 \(found -1\)",
        r"identification\.lag: there is no such key; there are: model, lags, .*mean 'lags'",
    ):
        assert any(re.search(line, entry) for entry in said), line
    assert len(said) == 8


@pytest.mark.parametrize(
    ("sections", "reason"),
    [
        ({"grid": {"period": 0.2, "max_gap": 0.1}}, r"grid\.max_gap: 0\.1 s is shorter"),
        ({"funnel": {"horizon": 0.001, "policy": "none"}}, r"funnel\.horizon: .* not one sample"),
        ({"inputs": 2}, "identification.model: linear has one response and one excitation"),
        (
            {
                "identification": {"model": "monotone", "lags": 2},
                "funnel": {"horizon": 1.0, "profile": [[0, 0], [1, 1]]},
            },
            "a plan is tracked by",
        ),
        (
            {
                "identification": {
                    "model": "state_affine",
                    "lags": 2,
                    "input_range": [[0, 1], [0, 2]],
                }
            },
            "input_range: 2 pairs .* needs 1",
        ),
    ],
)
def test_what_no_later_step_could_use_is_refused_when_the_file_is_read(
    tmp_path: Path, sections: dict[str, Any], reason: str
) -> None:
    given = {**sections}
    section = given.pop("identification", {"lags": 2})
    with pytest.raises(DataError, match="a later step could not use it") as caught:
        load_config(write_config(tmp_path / "robot.yaml", section, **given))
    assert re.search(reason, str(caught.value))


def test_signals_that_cannot_be_sampled_together_are_refused_all_at_once(tmp_path: Path) -> None:
    signals = {
        "response": {"name": "speed", "path": "/odom:twist.twist.linear.x|derivtive(1 s)"},
        "excitation": [
            {"name": "speed", "path": "/cmd:effort[*]"},
            {"name": "steering", "path": "odom"},
        ],
    }
    section = {"model": "state_affine", "lags": 2}
    with pytest.raises(DataError) as caught:
        load_config(write_config(tmp_path / "robot.yaml", section, signals=signals))
    for part in (
        "signals.response.path: 'derivtive(1 s)' in",
        "did you mean 'derivative'",
        "signals.excitation.0.path: /cmd:effort[*] is several signals",
        "signals.excitation.0.name: 'speed' is that of signals.response too",
        "signals.excitation.1.path: 'odom' has no ':'",
    ):
        assert part in str(caught.value)
    clocks = {
        "response": {"name": "speed", "path": "/odom:twist.twist.linear.x"},
        "excitation": {"name": "command", "path": "/cmd:linear.x|clock(log)"},
    }
    with pytest.raises(DataError, match="signals on two clocks cannot be paired"):
        load_config(write_config(tmp_path / "robot.yaml", section, signals=clocks))


# -- What a configuration may not say, and the page that lists every key of one

CONFIG = config_file("f1tenth.yaml")
PAGE = ROOT / "docs" / "configuration.md"


def edited(path: Path, **changes: Any) -> Path:
    """The shipped configuration with whole keys changed; None leaves one out."""
    content = yaml.safe_load(CONFIG.read_text()) | changes
    path.write_text(yaml.safe_dump({k: v for k, v in content.items() if v is not None}))
    return path


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"clock": "log"}, "clock: log"),
        ({"grid": {"period": 0.025, "max_gap": 0.1, "resample": "linear"}}, "resample: linear"),
    ],
)
def test_a_plan_that_no_controller_could_drive_is_refused(
    tmp_path: Path, changes: dict[str, Any], said: str
) -> None:
    with pytest.raises(DataError, match=f"funnel.profile: a plan is driven .*{said}"):
        load_config(edited(tmp_path / "robot.yaml", **changes))
    load_config(edited(tmp_path / "b.yaml", **changes, funnel={"safety_factor": 1.5}))


@pytest.mark.parametrize(
    ("split", "said"),
    [
        (None, "none of the bags is a test trial"),
        ({"test": ["trial_05"]}, "all of the bags are test trials"),
    ],
)
def test_a_split_that_scores_nothing_or_trains_on_nothing_is_said(
    tmp_path: Path, split: dict[str, Any] | None, said: str
) -> None:
    path = edited(tmp_path / "robot.yaml", split=split)
    only = [bag for bag in f1tenth() if bag.name == "trial_05"]
    assert said in nlsid("identify", tmp_path, *only, "--config", path, status=None)


def test_the_page_of_every_key_is_up_to_date() -> None:
    said = "python -m docs.site.configuration > docs/configuration.md"
    assert PAGE.read_text(encoding="utf-8") == configuration.page(), said


def every_section(kind: type[Section]) -> list[type[Section]]:
    inside = [s for f in kind.model_fields.values() for s in sections_in(f.annotation)]
    return [kind, *(found for section in inside for found in every_section(section))]


@pytest.mark.parametrize("kind", [Config, TrackingConfig])
def test_every_key_says_what_it_is_and_its_example_is_accepted(kind: type[Section]) -> None:
    for section in every_section(kind):
        types = get_type_hints(section, include_extras=True)
        for name, key in section.keys().items():
            assert key.text, name
            inside = sections_in(section.model_fields[name].annotation)
            assert inside or key.example is not None, f"{section.__name__}.{name}"
            if key.example is not None:
                TypeAdapter(types[name]).validate_python(key.example)


def test_every_option_of_a_class_and_a_method_is_on_the_page() -> None:
    text = PAGE.read_text(encoding="utf-8").replace("\\|", "|")
    said = [template.texts() for template in TEMPLATES.values()]
    for texts in (*said, *map(option_texts, METHODS.values())):
        for key, what in texts.items():
            assert what, key
            assert f"`{key}` | {what}" in text
