"""The command line `nlsid`: its verbs; `bag` and `fleet` have verbs of their own.

A command imports what it runs when it is called: `nlsid check` needs no NumPy, `--help` nothing.
"""

from typing import Annotated

import typer

from bags.commands import designs_cli, models_cli, running_cli
from bags.commands.bag_cli import bag_app
from bags.commands.fleet_cli import fleet_app
from bags.commands.options import flat

app = typer.Typer(
    name="nlsid",
    help="Learn how a robot answers its commands, prove it, and tell when it no longer does.",
    no_args_is_help=True,
    rich_markup_mode="markdown",
    pretty_exceptions_enable=False,
)
GROUPS = {
    "All steps": (designs_cli.learn,),
    "The steps": (
        models_cli.init,
        models_cli.identify,
        designs_cli.funnel,
        designs_cli.check,
        designs_cli.report,
        running_cli.monitor,
        designs_cli.export,
    ),
    "Live": (running_cli.run, running_cli.view),
    "More": (running_cli.demo,),
}
for group, verbs in GROUPS.items():
    for verb in verbs:
        app.command(verb.__name__, rich_help_panel=group)(flat(verb))
app.add_typer(bag_app, rich_help_panel="More")
app.add_typer(fleet_app, rich_help_panel="More")


def _say_version(wanted: bool) -> None:
    if wanted:
        from importlib.metadata import version

        typer.echo(f"nlsid {version('nlsid')}")
        raise typer.Exit


@app.callback()
def nlsid(
    _version: Annotated[
        bool,
        typer.Option("--version", callback=_say_version, is_eager=True, help="Print the version."),
    ] = False,
) -> None:
    """Learn how a robot answers its commands, prove it, and tell when it no longer does."""
