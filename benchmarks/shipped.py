"""The proofs of the examples that ship, made again."""

from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

from bags.chain.config import load_config
from bags.chain.shipped import config_file
from bags.chain.steps import design_funnel_files, identify_bags
from bags.designs import documents
from bags.samples import f1tenth
from examples import cart_pole, planar_quadrotor, quadrotor, satellite_funnel
from nlsid_core.design import design_funnel
from nlsid_core.progress import silent

QUADROTOR_LEVEL = 0.1  # of the goal, in LQR cost, as in benchmarks.quadrotor
QUADROTOR_KNOTS = 31


def shipped(folder: Path) -> Iterator[tuple[str, list[Path]]]:
    """Names and their proof files, each saved in a folder of its own."""
    designs: Mapping[str, Callable[[], Any]] = {
        "satellite": _satellite,
        "quadrotor": _quadrotor,
        "cart_pole": cart_pole.designed,
        "planar_quadrotor": planar_quadrotor.designed,
    }
    for name, design in designs.items():
        yield name, [design().save(folder / name)[-1]]
    out = folder / "f1tenth"
    config = load_config(config_file("f1tenth.yaml"))
    identify_bags(f1tenth(), config, out, progress=silent)
    design_funnel_files(out / documents.MODEL, config, out)
    yield "f1tenth", [out / documents.MODEL_PROOF, out / documents.FUNNEL_PROOF]


def _satellite() -> Any:
    field, nominal, weights = satellite_funnel.problem()
    return design_funnel(field, nominal, goal=satellite_funnel.goal_matrix(), **weights)


def _quadrotor() -> Any:
    dynamics, nominal, S = quadrotor.problem(QUADROTOR_KNOTS)
    return design_funnel(
        dynamics,
        nominal,
        goal=S / QUADROTOR_LEVEL,
        Q=quadrotor.Q / QUADROTOR_LEVEL,
        R=quadrotor.R / QUADROTOR_LEVEL,
    )
