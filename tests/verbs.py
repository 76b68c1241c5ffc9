"""The command line as tests ask it."""

from typer.testing import CliRunner

from bags.commands.cli import app


def nlsid(*arguments: object, status: int | tuple[int, ...] | None = 0, columns: int = 200) -> str:
    """What a verb prints if it ends with (one of) this status; None: what it raises, in words."""
    done = CliRunner().invoke(app, list(map(str, arguments)), env={"COLUMNS": str(columns)})
    if status is None:
        assert done.exception is not None, done.output
        return str(done.exception)
    wanted = (status,) if isinstance(status, int) else status
    assert done.exit_code in wanted, f"{done.output}\n{done.exception}"
    return done.output
