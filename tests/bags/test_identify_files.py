"""Every model class through the command line: bags and YAML in, files that `check` decides out."""

import json
import re
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from bags.chain.config import SplitConfig, load_config
from bags.chain.steps import read_trials, split
from bags.designs import documents
from bags.signals.grid import skipped_samples
from nlsid import Dataset, Grid, Trajectory, read_bags
from nlsid_core import files
from nlsid_core.errors import DataError
from nlsid_core.models import (
    BlockCascade,
    CellNetwork,
    DifferenceEquation,
    ImplicitModel,
    MonotoneEquation,
    StateAffineModel,
)
from nlsid_core.progress import silent
from tests.bag_messages import COMMAND, SPEED, speed_bag
from tests.identified_bags import (
    saturating,
    write_config,
    write_coupled_bags,
    write_saturating_bags,
)
from tests.marks import slow_among
from tests.verbs import nlsid

HOWTO = Path(__file__).resolve().parents[2] / "docs" / "howto-offline.md"
CASCADE = {
    "model": "block_cascade",
    "orders": [2, 1],
    "intervals": 8,
    "starts": 4,
    "transient": 60,
}
CLASSES: dict[str, tuple[dict[str, Any], Any]] = {
    "linear": ({"lags": 3}, DifferenceEquation),
    "state_affine": (
        {
            "model": "state_affine",
            "lags": 2,
            "method": "rse",
            "certified": True,
            "iterations": 3,
            "inputs_degree": 2,
        },
        StateAffineModel,
    ),
    "block_cascade": (CASCADE, BlockCascade),
    "monotone": ({"model": "monotone", "lags": 2, "delays": [0, 1]}, MonotoneEquation),
    "implicit": ({"model": "implicit", "lags": 2, "delays": [0, 1]}, ImplicitModel),
    "linear_states": ({"model": "linear_states"}, ImplicitModel),
    "cells": ({"model": "cells", "cells": 2, "intervals": 4}, CellNetwork),
    "follower": ({"model": "follower"}, CellNetwork),
    "feedback": ({"model": "feedback", "lags": 2, "stages": 1, "imitated": 20}, CellNetwork),
}
COEFFICIENTS = {
    "linear": "a",
    "state_affine": "coefficients",
    "block_cascade": "a1",
    "monotone": "a",
    "implicit": "coefficients",
    "linear_states": "coefficients",
    "cells": "next",
    "follower": "next",
    "feedback": "next",
}
LONG = {"cells", "feedback", "follower", "block_cascade", "state_affine", "monotone"}
STRONGER = {"rate": 0.2, "delta": 50.0}  # factors no proof here has room for
REASONS = {"rate": "the decrease of V", "delta": "inequality stable: not positive"}


def claimed(name: str) -> str:
    """What the claim of a class quantifies."""
    return "delta" if CLASSES[name][1] is ImplicitModel else "rate"


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_saturating_bags(tmp_path_factory.mktemp("bags"))


@pytest.fixture(scope="module")
def coupled(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_coupled_bags(tmp_path_factory.mktemp("coupled"))


def one_digit_changed(text: str, after: str) -> str:
    """The document with one digit of the first number after a key changed."""
    start = text.index(f'"{after}"') + len(after) + 2
    digit = re.compile(r"\d\.?(\d)").search(text, start)
    assert digit is not None
    place = digit.start(1)
    return text[:place] + str((int(text[place]) + 1) % 10) + text[place + 1 :]


@pytest.fixture(scope="module", params=slow_among(CLASSES, LONG))
def made(
    request: pytest.FixtureRequest, folder: Path, tmp_path_factory: pytest.TempPathFactory
) -> tuple[str, Path, str]:
    """A class's name, the folder that `nlsid identify` wrote, and what it said."""
    out = tmp_path_factory.mktemp(request.param)
    config = write_config(out / "robot.yaml", CLASSES[request.param][0])
    done = nlsid("identify", out, folder, "--config", config, "--verbose")
    return request.param, out, done


def test_each_class_is_identified_to_files_that_check_proves(made: tuple[str, Path, str]) -> None:
    name, out, said = made
    document = files.load_document(out / documents.MODEL)
    CLASSES[name][1].from_document(document)
    predicts = CLASSES[name][1] not in (BlockCascade, CellNetwork)  # these: what they simulate
    assert ("one step ahead: " in said) == predicts
    assert ("predicts what it simulates" in " ".join(said.split())) != predicts
    checked = nlsid("check", out / documents.MODEL_PROOF)
    stated = "the implicit model" if CLASSES[name][1] is ImplicitModel else "incremental stability"
    assert checked.startswith(f"PROVED {stated}")
    page = (out / documents.REPORT).read_text()
    assert 'class="proved"' in page
    assert "simulation residual is" in page


def test_a_digit_of_a_coefficient_undoes_the_proof(
    made: tuple[str, Path, str], tmp_path: Path
) -> None:
    name, out, _ = made
    shutil.copy(out / documents.MODEL_PROOF, tmp_path)
    genuine = (out / documents.MODEL).read_text()
    forged = one_digit_changed(genuine, COEFFICIENTS[name])
    assert forged != genuine
    (tmp_path / documents.MODEL).write_text(forged)
    refused = nlsid("check", tmp_path / documents.MODEL_PROOF, status=1)
    assert refused.startswith("REJECTED")


def test_a_stronger_claim_needs_another_proof(made: tuple[str, Path, str], tmp_path: Path) -> None:
    name, out, _ = made
    shutil.copy(out / documents.MODEL, tmp_path)
    document = json.loads((out / documents.MODEL_PROOF).read_text())
    document["claim"][claimed(name)] *= STRONGER[claimed(name)]
    path = tmp_path / documents.MODEL_PROOF
    path.write_text(json.dumps(document))
    refused = nlsid("check", path, status=1)
    assert REASONS[claimed(name)] in refused


# -- several inputs and outputs, gaps ----------------------------------------------------------


@pytest.mark.slow
@pytest.mark.pictures
def test_several_inputs_and_outputs_are_identified_and_scored_one_by_one(
    coupled: Path, tmp_path: Path
) -> None:
    section = {"model": "state_affine", "lags": 2, "inputs_degree": 2}
    config = write_config(tmp_path / "c.yaml", section, outputs=2, inputs=2)
    made = nlsid("identify", tmp_path / "out", coupled, "--config", config, "--verbose")
    assert "simulation error of each output:" in made
    checked = nlsid("check", tmp_path / "out" / documents.MODEL_PROOF)
    assert checked.startswith("PROVED incremental stability")
    model = StateAffineModel.from_document(files.load_document(tmp_path / "out" / documents.MODEL))
    assert [signal.name for signal in model.y] == ["angle 0", "angle 1"]
    page = (tmp_path / "out" / documents.REPORT).read_text()
    assert page.count("<svg") == 3, "two outputs, residuals"


def test_several_inputs_of_one_output_are_proved(coupled: Path, tmp_path: Path) -> None:
    section = {"model": "state_affine", "lags": 2, "input_range": [[-3.0, 3.0], [-2.5, 2.5]]}
    config = write_config(tmp_path / "c.yaml", section, outputs=1, inputs=2)
    nlsid("identify", tmp_path / "out", coupled, "--config", config)
    nlsid("check", tmp_path / "out" / documents.MODEL_PROOF)
    model = files.load_document(tmp_path / "out" / documents.MODEL)
    assert model["u_range"] == [[-3.0, 3.0], [-2.5, 2.5]]


def test_a_class_of_one_output_refuses_two_and_names_the_class_for_them(
    coupled: Path, tmp_path: Path
) -> None:
    config = write_config(tmp_path / "c.yaml", {"lags": 2}, outputs=2, inputs=2)
    said = nlsid("identify", tmp_path / "out", coupled, "--config", config, status=None)
    assert "take state_affine or implicit, or leave out signals" in said


def test_nan_and_missing_samples_are_skipped_with_a_count(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    for k in range(3):
        u = rng.uniform(-2.0, 2.0, 300)
        y = saturating().simulate(u)
        if k == 0:
            y[100:110] = np.nan  # 0.25 s, longer than max_gap
            y[200] = np.nan  # 0.05 s between neighbours: interpolated
        speed_bag(tmp_path / "bags" / f"run_{k}", y, u)
    sections: dict[str, Any] = {
        "signals": {
            "response": {"name": "speed", "path": SPEED},
            "excitation": {"name": "command", "path": COMMAND},
        },
        "split": {"test": ["run_2"]},
        "grid": {"period": 0.025, "max_gap": 0.1},
    }
    config, bags = tmp_path / "c.yaml", tmp_path / "bags"
    write_config(config, {"lags": 2}, **sections)
    refused = nlsid("identify", tmp_path / "out", bags, "--config", config, status=None)
    assert "nan in message 100" in refused
    sections["grid"]["split_gaps"] = True
    write_config(config, {"lags": 2}, **sections)
    made = nlsid("identify", tmp_path / "out", bags, "--config", config)
    assert "10 samples skipped in gaps" in made
    names = files.load_document(tmp_path / "out" / documents.MODEL)["bags"]
    assert [bag["name"] for bag in names] == ["run_0.1", "run_0.2", "run_1"]


def test_stretches_of_one_bag_are_not_repeats_of_each_other(tmp_path: Path) -> None:
    speeds = np.random.default_rng(1).standard_normal(100)
    speeds[40:60] = np.nan
    bag = speed_bag(tmp_path / "run", speeds, np.arange(100.0), custom={"repeat_group": "a"})
    data = read_bags([bag], responses=[SPEED], excitations=[COMMAND], grid=Grid(split_gaps=True))
    assert [len(trial) for trial in data] == [40, 40]
    assert not data.repeats()
    assert skipped_samples(data) == 20
    nothing = speed_bag(tmp_path / "none", np.full(9, np.nan), np.arange(9.0))
    with pytest.raises(DataError, match=r"is nan in message 0 .*\(9 of 9"):
        read_bags([nothing], responses=[SPEED], excitations=[COMMAND], grid=Grid(split_gaps=True))


@pytest.mark.parametrize(
    ("named", "reason"),
    [
        ({"test": "b", "calibration": "d"}, "none of the bags is a calibration trial"),
        ({}, "none of the bags is a test trial; split.test names nothing"),
        ({"test": "b", "calibration": "b"}, "'b' is named for test and for calibration"),
        ({"test": "b", "calibration": "a c"}, "all of the bags are test or calibration"),
        ({"test": "a", "calibration": "*1"}, r"'a\.1' is named for test and for calibration"),
        ({"test": "b", "calibration": "?"}, "'b' is named for test and for calibration"),
    ],
)
def test_bags_that_cannot_be_split_as_they_are_named_are_refused(
    named: dict[str, str], reason: str
) -> None:
    with pytest.raises(DataError, match=reason):
        split(four_trials(), SplitConfig.model_validate({u: n.split() for u, n in named.items()}))


def four_trials() -> Dataset:
    """Three bags, of which one was cut at a gap."""
    names = ("a.1", "a.2", "b", "c")
    ones = np.ones(4)
    return Dataset(tuple(Trajectory(t=np.arange(4.0), y=ones, u=ones, name=n) for n in names))


def test_bags_are_split_by_name_also_where_they_were_cut() -> None:
    found = split(four_trials(), SplitConfig(test=("b",), calibration=("a", "no such bag")))
    assert found.calibration is not None
    assert (found.calibration.names, found.train.names) == (("a.1", "a.2"), ("c",))


def test_a_split_that_no_bag_fits_is_refused_before_a_bag_is_read(tmp_path: Path) -> None:
    config = load_config(write_config(tmp_path / "robot.yaml", {"model": "linear", "lags": 2}))
    names = config.split.model_copy(update={"test": ["another"]})
    given = config.model_copy(update={"split": names})
    with pytest.raises(DataError, match=r"split\.test names another; the bags are not_there"):
        read_trials([tmp_path / "not_there"], given, progress=silent)


# -- models without a proof ---------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.pictures
def test_an_unproved_model_is_refused_unless_asked_for_and_leaves_no_old_proof(
    coupled: Path, tmp_path: Path
) -> None:
    unproved = {"lags": 2, "method": "least_squares", "max_rate": 0.01}
    config = write_config(tmp_path / "c.yaml", {"lags": 2})
    nlsid("identify", tmp_path, coupled, "--config", config)
    assert (tmp_path / documents.MODEL_PROOF).exists()
    config = write_config(tmp_path / "c.yaml", unproved)
    refused = nlsid("identify", tmp_path, coupled, "--config", config, status=None)
    assert "no proof" in refused
    assert (tmp_path / documents.MODEL_PROOF).exists(), "nothing was written"
    config = write_config(tmp_path / "c.yaml", unproved | {"allow_unproved": True})
    made = nlsid("identify", tmp_path, coupled, "--config", config)
    assert "NOT PROVED stable" in made
    assert not (tmp_path / documents.MODEL_PROOF).exists()
    assert "NOT PROVED stable" in (tmp_path / documents.REPORT).read_text()


# -- the documentation -------------------------------------------------------------------------


def examples() -> list[dict[str, Any]]:
    blocks = re.findall(r"```yaml\n(.*?)```", HOWTO.read_text(), re.DOTALL)
    return [content for block in blocks if "identification" in (content := yaml.safe_load(block))]


@pytest.mark.slow  # the classes are identified above; here the page's own words for them are
@pytest.mark.parametrize("example", examples(), ids=lambda e: "-".join(e) + str(len(str(e))))
@pytest.mark.pictures
def test_every_example_of_the_how_to_runs(
    example: dict[str, Any], folder: Path, tmp_path: Path
) -> None:
    content = dict(example)
    config = write_config(tmp_path / "robot.yaml", content.pop("identification"), **content)
    nlsid("identify", tmp_path / "out", folder, "--config", config)
    nlsid("check", tmp_path / "out" / documents.MODEL_PROOF)


def test_the_how_to_has_an_example_of_every_class() -> None:
    models = {e["identification"].get("model", "linear") for e in examples()}
    assert models == set(CLASSES)
