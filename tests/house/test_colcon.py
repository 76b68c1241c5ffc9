"""The tree as a ROS 2 package: both of colcon's builds, and what `ros2 run` would find there."""

import os
import re
import shlex
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
NOT_SOURCE = shutil.ignore_patterns(
    ".*", "__pycache__", "*.egg-info", "build", "install", "log", "out", "dist", "nlsid-demo"
)
EXECUTABLES = {
    "model_identifier",
    "nlsid",
    "bag_player",
    "excitation",
    "funnel_monitor",
    "funnel_publisher",
    "plant",
    "tracking_controller",
    "trajectory_recorder",
    "viewer",
}

pytestmark = [
    pytest.mark.colcon,
    pytest.mark.skipif(shutil.which("colcon") is None, reason="colcon is not installed"),
]


class Workspace:
    """A colcon workspace with this tree in src and the result of one build in install."""

    def __init__(self, folder: Path, *options: str) -> None:
        self.prefix = folder / "install" / "nlsid"
        self._folder = folder
        shutil.copytree(ROOT, folder / "src" / "nlsid", ignore=NOT_SOURCE)
        self.run("colcon", "build", *options)

    def run(self, *command: str) -> str:
        """Output of a command in the workspace, without this interpreter's environment."""
        hidden = ("VIRTUAL_ENV", "AMENT_PREFIX_PATH", "COLCON_PREFIX_PATH")
        environment = {
            name: value
            for name, value in os.environ.items()
            if name not in hidden and not name.startswith("PYTHON")
        }
        process = subprocess.run(
            command,
            cwd=self._folder,
            env=environment,
            stdin=subprocess.DEVNULL,
            capture_output=True,
            text=True,
            check=False,
        )
        assert process.returncode == 0, process.stdout + process.stderr
        return process.stdout

    def run_sourced(self, *command: str) -> str:
        """The same in a shell that has sourced the workspace, as a user of ROS does."""
        return self.run("bash", "-c", f". install/setup.bash && {shlex.join(command)}")


# Colcon runs the tests with the Python it runs on; the system's has colcon but not what we need.
COLCON_HERE = """import sys
sys.path.insert(0, {!r})
from colcon_core.command import main
sys.exit(main())
"""


@pytest.fixture(scope="module", params=["", "--symlink-install"], ids=["copied", "symlinked"])
def workspace(
    request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory
) -> Iterator[Workspace]:
    folder = tmp_path_factory.mktemp("colcon")
    yield Workspace(folder, *[request.param] if request.param else [])
    shutil.rmtree(folder)


def test_executables_are_where_ros2_run_looks(workspace: Workspace) -> None:
    installed = list((workspace.prefix / "lib" / "nlsid").iterdir())
    assert {path.name for path in installed} == EXECUTABLES
    assert all(os.access(path, os.X_OK) for path in installed)


def test_the_package_is_in_the_resource_index_with_its_manifest(workspace: Workspace) -> None:
    share = workspace.prefix / "share"
    assert (share / "ament_index" / "resource_index" / "packages" / "nlsid").is_file()
    assert (share / "nlsid" / "package.xml").read_text() == (ROOT / "package.xml").read_text()


@pytest.mark.parametrize("folder", ["launch", "config"])
def test_launch_and_configuration_files_are_in_the_share_folder(
    workspace: Workspace, folder: str
) -> None:
    def names(parent: Path) -> set[str]:
        return {path.name for path in parent.iterdir() if path.is_file()}

    assert names(workspace.prefix / "share" / "nlsid" / folder) == names(ROOT / folder)


def test_ament_finds_the_package_in_a_sourced_workspace(workspace: Workspace) -> None:
    pytest.importorskip("ament_index_python", reason="comes with the extra `ros`")
    question = "import ament_index_python as a; print(a.get_package_prefix('nlsid'))"
    assert workspace.run_sourced(sys.executable, "-c", question).strip() == str(workspace.prefix)


def test_an_installed_executable_runs_on_the_installed_code(workspace: Workspace) -> None:
    # The system's Python has colcon but not our dependencies; this interpreter has them, and the
    # sourced workspace puts the installed packages before any other copy it knows.
    executable = workspace.prefix / "lib" / "nlsid" / "nlsid"
    assert "identify" in workspace.run_sourced(sys.executable, str(executable), "--help")

    places = (
        "import bags.chain.shipped as s; print(s.__file__); print(s.config_file('f1tenth.yaml'))"
    )
    module, config = workspace.run_sourced(sys.executable, "-c", places).splitlines()
    root = workspace.prefix.parents[1]
    assert Path(module).is_relative_to(root)
    assert Path(config).is_relative_to(root)
    assert Path(config).read_text() == (ROOT / "config" / "f1tenth.yaml").read_text()


def test_the_sample_bags_are_installed_with_their_licence(workspace: Workspace) -> None:
    script = "import bags.samples as s; print(s.__path__[0])"
    installed = Path(workspace.run_sourced(sys.executable, "-c", script).strip())
    shipped = files_below(ROOT / "bags" / "samples")
    assert "f1tenth/LICENSE" in shipped
    assert files_below(installed) == shipped


# The tests that colcon runs here: those of the tree itself, of what is installed beside the code
# (configurations, sample bags, launch files) and of a chain from bags to a verdict. Every other is
# collected, so that all of them import as colcon runs them; what they find does not depend on it.
HERE = "test_imports or test_launching or test_samples or test_config_check or test_chain"
PLANTED = "def test_planted():\n    assert False, 'planted'\n"


@pytest.fixture(scope="module")
def colcon_test(workspace: Workspace) -> tuple[str, ...]:
    """`colcon test`, run by this interpreter, with what pytest prints."""
    where = "import pathlib, colcon_core as c; print(pathlib.Path(c.__file__).parents[1])"
    colcon = COLCON_HERE.format(workspace.run("/usr/bin/python3", "-c", where).strip())
    shown = ("--event-handlers", "console_cohesion+", "--return-code-on-test-failure")
    return (sys.executable, "-c", colcon, "test", *shown, "--pytest-args")


@pytest.mark.parametrize("workspace", [""], indirect=True, ids=["copied"])
def test_colcon_finds_all_tests_and_those_of_the_package_pass(
    workspace: Workspace, colcon_test: tuple[str, ...]
) -> None:
    shown = workspace.run(*colcon_test, "-k", HERE)
    counted = re.search(r"collected (\d+) items", shown)
    assert counted is not None, shown
    assert int(counted[1]) > 3000
    tests, errors, failures, skipped = results(workspace)
    assert tests - skipped > 50
    assert (errors, failures) == (0, 0)


@pytest.mark.parametrize("workspace", [""], indirect=True, ids=["copied"])
def test_colcon_says_that_a_test_failed(
    workspace: Workspace, colcon_test: tuple[str, ...], tmp_path: Path
) -> None:
    planted = tmp_path / "test_planted.py"
    planted.write_text(PLANTED)
    with pytest.raises(AssertionError, match="1 failed"):
        workspace.run(*colcon_test, str(planted))


def results(workspace: Workspace) -> list[int]:
    """Tests, errors, failures and skipped ones of the last `colcon test`."""
    summary = workspace.run("colcon", "test-result").splitlines()[-1]
    return [int(number) for number in re.findall(r"\d+", summary)]


def files_below(folder: Path) -> set[str]:
    """Names of the files in `folder`, but for what Python compiled there."""
    files = (path.relative_to(folder) for path in folder.rglob("*") if path.is_file())
    return {str(path) for path in files if path.suffix != ".pyc"}
