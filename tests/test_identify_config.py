"""What the section `identification` refuses: key, value and what is allowed are named."""

from pathlib import Path
from typing import Any

import pytest

from bags.chain.config import load_config
from nlsid_core.errors import DataError
from nlsid_core.identification import (
    BlockCascadeClass,
    ImplicitClass,
    LinearClass,
    LinearStateClass,
    MonotoneClass,
    StateAffineClass,
)
from tests.identified_bags import write_config


@pytest.mark.parametrize(
    ("section", "expected"),
    [
        ({"lags": 4}, LinearClass(4)),
        ({"model": "state_affine", "lags": 2, "input_range": [-1, 1.5], "delays": [1, 2]},
         StateAffineClass(2, delays=(1, 2), u_range=((-1.0, 1.5),))),
        ({"model": "state_affine", "lags": 2, "input_range": [[0, 1], [2, 3]],
          "on_out_of_range": "refuse"},
         StateAffineClass(2, u_range=((0.0, 1.0), (2.0, 3.0)), on_out_of_range="refuse")),
        ({"model": "block_cascade", "orders": [2, 0], "intervals": [8]},
         BlockCascadeClass((2, 0), intervals=(8,))),
        ({"model": "monotone", "lags": 3, "degree": 1}, MonotoneClass(3, degree=1)),
        ({"model": "implicit", "set": "2.13", "delays": [1], "box": [[-1, 1], [0, 2]]},
         ImplicitClass(1, (1,), "2.13", box=((-1.0, 1.0), (0.0, 2.0)))),
        ({"model": "linear_states"}, LinearStateClass()),
    ],
)  # fmt: skip
def test_each_section_says_a_model_class(
    tmp_path: Path, section: dict[str, Any], expected: object
) -> None:
    config = load_config(write_config(tmp_path / "robot.yaml", section))
    assert config.identification.model_class == expected


@pytest.mark.parametrize(
    ("section", "reason"),
    [
        ({"model": "wiener", "lags": 2},
         "identification: there is no such model; there are: linear, state_affine, block_cascade"),
        ({"lags": 2, "orders": [1, 2]},
         r"identification.orders: there is no such key; there are: .*lags \(found \[1, 2\]\)"),
        ({"lags": 2, "method": "magic"},
         r"identification.method: Input should be 'rse', .* or 'sem_certified' \(found 'magic'\)"),
        ({"lags": 2, "seed": 1}, "identification.seed: there is no such key"),
        ({"model": "state_affine", "lags": 2, "lagged_degree": 2, "method": "rse_certified"},
         "method 'rse_certified' is not for these degrees"),
        ({"model": "state_affine", "lags": 2, "delays": [3]}, "should be between 0 and 2"),
        ({"model": "state_affine", "lags": 2, "on_out_of_range": "warn"},
         r"on_out_of_range: Input should be 'clip' or 'refuse' \(found 'warn'\)"),
        ({"model": "state_affine", "lags": 2, "input_range": [0, 1, 2]}, "at most 2 items"),
        ({"model": "block_cascade", "orders": [0, 0]}, "not both zero"),
        ({"model": "block_cascade", "phases": [9]}, "phases .* should be between 1 and"),
        ({"model": "monotone", "lags": 2, "degree": 2}, r"degree: Input should be 1 or 3"),
        ({"model": "implicit", "set": 2.13}, r"set: Input should be '2.10', .* \(found 2.13\)"),
        ({"model": "implicit", "set": "2.13", "lags": 2}, "set 2.13 is for 1 lag"),
        ({"model": "implicit", "right_degree": 3}, "needs a box in set 2.11"),
        ({"model": "implicit", "coupled": True}, "stable on a box only"),
        ({"model": "linear_states", "lags": 1}, "identification.lags: there is no such key"),
    ],
)  # fmt: skip
def test_a_wrong_identification_names_key_value_and_what_is_allowed(
    tmp_path: Path, section: dict[str, Any], reason: str
) -> None:
    with pytest.raises(DataError, match=reason):
        load_config(write_config(tmp_path / "robot.yaml", section))


def test_a_wrong_entry_of_compare_is_found_by_its_number(tmp_path: Path) -> None:
    path = write_config(tmp_path / "robot.yaml", {"lags": 2}, compare=[{"lags": 1}, {"lags": 0}])
    with pytest.raises(DataError, match=r"compare\.1\.lags: .*\(found 0\)"):
        load_config(path)
