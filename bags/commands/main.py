"""The entry point `nlsid`: runs a verb, and says in one line what is wrong.

`nlsid run` and the verbs of `nlsid bag` need none of what the others import, and are found without
them.
"""

import io
import os
import sys
import warnings
from typing import Any

from nlsid_core.errors import NlsidError

# The matrices of a search are small: threads for them wait for each other, ten times as long.
os.environ.setdefault("OMP_NUM_THREADS", "1")

EXTRAS = {
    **dict.fromkeys(("scipy", "cvxpy", "clarabel", "pydantic"), "identify"),
    **dict.fromkeys(("pandas", "pyarrow"), "export"),
    **dict.fromkeys(("obstore", "distributed"), "fleet"),
    "matplotlib": "report",
    "mujoco": "sim",
    "rclpy": "ros",
}  # what brings a module that a verb needs


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
            if sys.argv[1:2] == ["bag"]:
                from bags.commands.bag_cli import bag_app

                bag_app(sys.argv[2:], prog_name="nlsid bag")
            elif sys.argv[1:2] == ["run"]:
                from bags.commands.running_cli import run_app

                run_app(sys.argv[2:], prog_name="nlsid run")
            else:
                from bags.commands.cli import app

                app()
        finally:
            sys.stdout.flush()
    except NlsidError as error:
        said = str(error)
    except ModuleNotFoundError as error:
        package = (error.name or "").partition(".")[0]
        if package not in EXTRAS:
            raise
        said = f"this needs {package}: pip install 'nlsid[{EXTRAS[package]}]'"
    except OSError as error:
        said = f"{error.filename}: {error.strerror}" if error.filename else str(error)
        os.dup2(os.open(os.devnull, os.O_WRONLY), 1)  # what could not be written is not tried again
    else:
        return
    print(f"error: {said}", file=sys.stderr)
    sys.exit(2)


if __name__ == "__main__":
    main()
