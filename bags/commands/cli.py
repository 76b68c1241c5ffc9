"""The command line `nlsid`: its verbs; `bag` and `fleet` have verbs of their own.

A command imports what it runs when it is called: `nlsid check` needs no NumPy, `--help` nothing.
"""

import io
import os
import sys
import warnings
from typing import Annotated, Any

import typer
from rich.markup import escape

from bags.commands import designs_cli, learn_cli, models_cli, running_cli
from bags.commands.bag_cli import bag_app
from bags.commands.fleet_cli import fleet_app
from bags.commands.options import err, flat
from nlsid_core.errors import NlsidError

# The matrices of a search are small: threads for them wait for each other, ten times as long.
os.environ.setdefault("OMP_NUM_THREADS", "1")

app = typer.Typer(
    name="nlsid",
    help="From a recorded bag to a proved model, a proved tracking tube and a monitor.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
)
GROUPS = {
    "All steps": (learn_cli.learn,),
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
        typer.Option("--version", callback=_say_version, is_eager=True, help="Say which it is."),
    ] = False,
) -> None:
    """From a recorded bag to a proved model, a proved tracking tube and a monitor."""


class _Written(io.FileIO):
    """A standard stream whose reader may leave early (`nlsid ... | head`): the rest is dropped.

    What a command finds, and the status that says it, is the same whoever reads along.
    """

    def write(self, content: Any, /) -> int:
        """Write the content, or count it as written where nobody reads it."""
        try:
            return super().write(content)
        except BrokenPipeError:
            return memoryview(content).nbytes


def _prepare_streams() -> None:
    """Let readers leave early, and keep the warnings of libraries from people.

    Warnings are for who writes programs: `python -W` brings them back.
    """
    if not sys.warnoptions:
        warnings.simplefilter("ignore")
        os.environ.setdefault("PYTHONWARNINGS", "ignore")  # of the processes that share the work

    for name in ("stdout", "stderr"):
        stream = getattr(sys, name)
        if type(stream) is io.TextIOWrapper:  # neither closed nor captured by who called
            written = io.BufferedWriter(_Written(stream.fileno(), "wb", closefd=False))
            patient = io.TextIOWrapper(
                written, stream.encoding, stream.errors, line_buffering=stream.line_buffering
            )
            setattr(sys, name, patient)


def main() -> None:
    """Entry point: errors made for people are shown as one message and end with status 2.

    Status 0 says yes, 1 no (not fit, outside, rejected), 2 that it could not be done or judged.
    """
    _prepare_streams()
    try:
        try:
            app()
        finally:
            sys.stdout.flush()
    except NlsidError as error:
        err.print(f"[red]error:[/red] {escape(str(error))}", soft_wrap=True, highlight=False)
        sys.exit(2)
    except OSError as error:
        said = f"{error.filename}: {error.strerror}" if error.filename else str(error)
        err.print(f"error: {said}", soft_wrap=True, markup=False, highlight=False)
        os.dup2(os.open(os.devnull, os.O_WRONLY), 1)  # what could not be written is not tried again
        sys.exit(2)


if __name__ == "__main__":
    main()
