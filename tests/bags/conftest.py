"""What several tests hold recordings against: F1TENTH's design, made once in each process."""

from pathlib import Path

import pytest
from typer.testing import CliRunner

from bags.chain.shipped import config_file
from bags.commands.cli import app
from bags.samples import f1tenth


@pytest.fixture(scope="session")
def f1tenth_chain(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder that `nlsid identify` and `nlsid funnel` write for F1TENTH; to be read only."""
    out, runner = tmp_path_factory.mktemp("chain"), CliRunner()
    shared = ["--config", str(config_file("f1tenth.yaml"))]
    made = runner.invoke(app, ["identify", str(out), str(f1tenth()[0].parent), *shared])
    assert made.exit_code == 0, made.output
    assert "robust simulation error" in made.output
    made = runner.invoke(app, ["funnel", str(out), *shared])
    assert made.exit_code == 0, made.output
    return out
