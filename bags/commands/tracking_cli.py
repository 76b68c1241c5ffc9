"""`nlsid track`: from a robot's recordings to a proved funnel around a motion of it, and back.

What its commands do is in `track`, imported when one is called.
"""

from pathlib import Path
from typing import Annotated

import typer

app = typer.Typer(
    help="A measured state: model from repeats, motion, proved sampled funnel, monitor.",
    no_args_is_help=True,
)

ConfigOption = Annotated[Path, typer.Option(help="The robot's YAML configuration.")]
OutOption = Annotated[Path, typer.Option("--out", help="Folder for the results.")]
BagsArgument = Annotated[list[Path], typer.Argument(help="Bags, or folders of bags.")]
DesignOption = Annotated[Path, typer.Option(help="Folder with model.json and policy.json.")]


@app.command()
def simulate(config: ConfigOption, out_dir: OutOption) -> None:
    """Record the configured robot in MuJoCo (extra `sim`): repeats of excitations, as bags."""
    from bags.commands import track

    track.simulate(config, out_dir)


@app.command()
def identify(bags: BagsArgument, config: ConfigOption, out_dir: OutOption) -> None:
    """Identify x⁺ = f(x, u) from repeats: model.json, and free_run.png of validation bags."""
    from bags.commands import track

    track.identify(bags, config, out_dir)


@app.command()
def plan(
    model: Annotated[Path, typer.Option(help="The model.json of `nlsid track identify`.")],
    config: ConfigOption,
    out_dir: OutOption,
) -> None:
    """Plan the configured motion on the model, and its feedback: policy.json, and motion.png."""
    from bags.commands import track

    track.plan(model, config, out_dir)


@app.command()
def drive(design: DesignOption, config: ConfigOption, out_dir: OutOption) -> None:
    """Commission the policy on the simulated robot: bags that measure the disturbance."""
    from bags.commands import track

    track.drive(design, config, out_dir)


@app.command()
def funnel(bags: BagsArgument, design: DesignOption, config: ConfigOption) -> None:
    """Measure the disturbance on commissioning bags and prove the funnel: funnel.json, its proof.

    Draws funnel.png beside them.
    """
    from bags.commands import track

    track.funnel(bags, design, config)


@app.command()
def monitor(
    bags: BagsArgument,
    funnel: Annotated[Path, typer.Option(help="The funnel.json of `nlsid track funnel`.")],
) -> None:
    """Hold recorded runs of the policy against its funnel; status 1 if one is not inside.

    Draws monitor.png beside the funnel.
    """
    from bags.commands import track

    if not track.monitor(bags, funnel):
        raise typer.Exit(1)


@app.command()
def run(config: ConfigOption, out_dir: OutOption) -> None:
    """All steps on the configured simulated robot; its bags, model, policy, funnel and proof."""
    from bags.commands import track

    if not track.run(config, out_dir):
        raise typer.Exit(1)
