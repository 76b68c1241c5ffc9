"""What a configuration may not say, and the page that lists every key of one."""

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
from nlsid_core.identification import METHODS
from tests.house.sources import ROOT
from tests.verbs import nlsid

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
