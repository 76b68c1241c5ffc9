"""The proofs of the examples that ship, made again."""

from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

from bags.chain import tracking_steps
from bags.chain.config import load_config
from bags.chain.shipped import config_file
from bags.chain.simulation import simulate_excitations, simulate_runs
from bags.chain.steps import design_funnel_files, identify_bags
from bags.chain.tracking_config import load_tracking_config
from bags.designs import documents
from bags.samples import f1tenth
from examples import (
    cart_pole,
    planar_quadrotor,
    quadrotor,
    satellite_funnel,
    torque_limited_pendulum,
)
from nlsid_core.progress import silent


def shipped(folder: Path) -> Iterator[tuple[str, list[Path]]]:
    """Names and their proof files, each saved in a folder of its own."""
    designs: Mapping[str, Callable[[], Any]] = {
        "satellite": satellite_funnel.designed,
        "quadrotor": quadrotor.designed,
        "cart_pole": cart_pole.designed,
        "planar_quadrotor": planar_quadrotor.designed,
        "torque_limited_pendulum": torque_limited_pendulum.designed,
    }
    for name, design in designs.items():
        yield name, [design().save(folder / name)[-1]]
    out = folder / "f1tenth"
    config = load_config(config_file("f1tenth.yaml"))
    identify_bags(f1tenth(), config, out, progress=silent)
    design_funnel_files(out / documents.MODEL, config, out)
    yield "f1tenth", [out / documents.MODEL_PROOF, out / documents.FUNNEL_PROOF]
    yield "pendulum", [_tracked_pendulum(folder / "pendulum")]


def _tracked_pendulum(out: Path) -> Path:
    """The sampled funnel of config/pendulum.yaml, from bags of the robot in MuJoCo."""
    config = load_tracking_config(config_file("pendulum.yaml"))
    fit = tracking_steps.identify_state_bags(
        simulate_excitations(config, out / "excitations"), config, out
    )
    tracking_steps.plan_tracking(fit, config, out)
    runs = simulate_runs(out, config, out / "runs")
    tracking_steps.design_tracking_funnel(out, runs, config, progress=silent)
    return out / documents.FUNNEL_PROOF
