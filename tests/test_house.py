"""The rules of the house: who may import whom, what is documented, how long a file may be."""

import ast
import re
import subprocess
import sys
import tomllib
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import pytest

ROOT = Path(__file__).resolve().parents[1]
PACKAGES = ("nlsid_core", "bags", "nlsid_ros")
WRITTEN_BY_HAND = (*PACKAGES, "tests", "examples", "benchmarks")
MAX_LINES = 400

# Each package may import itself and those before it.
DOWNWARD = {
    "nlsid_core": {"nlsid_core"},
    "bags": {"nlsid_core", "bags"},
    "nlsid_ros": {"nlsid_core", "bags", "nlsid_ros"},
}
# The rooms of bags, each standing on those before it.
ROOMS = ("recordings", "signals", "tools", "monitoring", "pictures", "chain", "commands")
# The rest of nlsid_core decides, holds or measures; a robot that monitors needs no solver.
SEARCH = {"identification", "funnels", "sos", "conic"}
SOLVERS = {"clarabel", "cvxpy"}
WRITTEN_IN_CVXPY = {"nlsid_core/funnels/discrete.py"}  # one small problem, solved once a funnel
SYMPY_EDGE = {"nlsid_core/polynomial/sympy_edge.py"}  # optional, and imported by nobody inside
BAG_FORMATS = {"rosbags", "mcap"}
ROS = re.compile(
    r"rcl\w*|ros\w*_runtime_py|\w+_(msgs|srvs|interfaces)|ament_\w+|launch(_ros)?|tf2\w*"
)


def sources(*folders: str) -> list[Path]:
    return [path for folder in folders for path in sorted((ROOT / folder).rglob("*.py"))]


def module_name(path: Path) -> str:
    parts = path.relative_to(ROOT).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


def imported_modules(path: Path) -> set[str]:
    """Everything imported anywhere in the file, also inside functions."""
    names: set[str] = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: relative import; name the module in full"
            assert node.module is not None
            names.add(node.module)
    return names


def imported_packages(path: Path) -> set[str]:
    return {name.partition(".")[0] for name in imported_modules(path)}


def is_base(path: Path) -> bool:
    parts = path.relative_to(ROOT).with_suffix("").parts
    return parts[0] == "nlsid_core" and parts[1] not in SEARCH


def solvers_known_to(path: Path) -> set[str]:
    if path == ROOT / "nlsid_core" / "conic.py":
        return SOLVERS
    return {"cvxpy"} if ids(path) in WRITTEN_IN_CVXPY else set()


def ids(path: Path) -> str:
    return str(path.relative_to(ROOT))


@pytest.mark.parametrize("path", sources(*PACKAGES), ids=ids)
def test_imports_go_only_downward(path: Path) -> None:
    package = path.relative_to(ROOT).parts[0]
    upward = imported_packages(path) & set(PACKAGES) - DOWNWARD[package]
    assert not upward, f"{package} imports {upward}"


@pytest.mark.parametrize("path", [p for room in ROOMS for p in sources(f"bags/{room}")], ids=ids)
def test_a_room_of_bags_knows_only_the_rooms_below_it(path: Path) -> None:
    above = ROOMS[ROOMS.index(path.relative_to(ROOT).parts[1]) + 1 :]
    known = {m.split(".")[1] for m in imported_modules(path) if m.startswith("bags.")}
    assert not known & set(above)


@pytest.mark.parametrize("path", sources(*PACKAGES), ids=ids)
def test_each_foreign_library_has_one_owner(path: Path) -> None:
    imported = imported_packages(path)
    assert imported & SOLVERS <= solvers_known_to(path), "only nlsid_core/conic.py knows a solver"
    package = path.relative_to(ROOT).parts[0]
    if package != "bags":
        assert not imported & BAG_FORMATS, "only bags knows rosbags and mcap"
    if package != "nlsid_ros":
        ros = {name for name in imported if ROS.fullmatch(name)}
        assert not ros, f"only nlsid_ros knows ROS, not {ros}"


@pytest.mark.parametrize("path", sources("nlsid_core"), ids=ids)
def test_the_core_stands_on_numpy_and_the_search_on_scipy(path: Path) -> None:
    allowed = {"numpy", "nlsid_core", *sys.stdlib_module_names}
    if not is_base(path):
        allowed |= {"scipy"} | solvers_known_to(path)
    if ids(path) in SYMPY_EDGE:
        allowed |= {"sympy"}
    foreign = imported_packages(path) - allowed
    assert not foreign, f"{ids(path)} imports {foreign}"


def packages_loaded_by(modules: list[str]) -> set[str]:
    """Top-level packages that a fresh interpreter has after importing `modules` and not before."""
    script = (
        "import sys; before = set(sys.modules)\n"
        f"sys.path.insert(0, {str(ROOT)!r})\n"
        "import importlib\n"
        f"for name in {modules!r}: importlib.import_module(name)\n"
        "print(*{name.partition('.')[0] for name in set(sys.modules) - before})"
    )
    process = subprocess.run(
        [sys.executable, "-c", script], capture_output=True, text=True, check=False, cwd=ROOT
    )
    assert process.returncode == 0, process.stderr
    return set(process.stdout.split())


def test_checking_and_monitoring_load_nothing_but_numpy() -> None:
    modules = [module_name(path) for path in sources("nlsid_core") if is_base(path)]
    assert {"nlsid_core.certificate", "nlsid_core.models"} <= set(modules)
    with_numpy = packages_loaded_by(["numpy"]) | set(sys.stdlib_module_names)
    assert packages_loaded_by(modules) - with_numpy == {"nlsid_core"}


def test_the_core_and_the_bags_load_no_ros() -> None:
    loaded = packages_loaded_by([module_name(path) for path in sources("nlsid_core", "bags")])
    assert "bags" in loaded
    assert not {name for name in loaded if ROS.fullmatch(name)}


def test_every_folder_of_modules_is_a_package_and_so_gets_installed() -> None:
    folders = {path.parent for path in sources(*PACKAGES)}
    assert not {folder for folder in folders if not (folder / "__init__.py").is_file()}


Definition = ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef


def public_definitions(body: list[ast.stmt], prefix: str) -> Iterator[tuple[str, Definition]]:
    """Public classes and functions of a module, and the public methods of those classes."""
    for node in body:
        if isinstance(node, Definition) and not node.name.startswith("_"):
            yield f"{prefix}.{node.name}", node
            if isinstance(node, ast.ClassDef):
                yield from public_definitions(node.body, f"{prefix}.{node.name}")


def is_overload(node: Definition) -> bool:
    """A signature for the type checker; the docstring is on the function that follows."""
    return any(isinstance(d, ast.Name) and d.id == "overload" for d in node.decorator_list)


@pytest.mark.parametrize("path", sources(*PACKAGES), ids=ids)
def test_everything_public_has_a_docstring(path: Path) -> None:
    tree = ast.parse(path.read_text())
    name = module_name(path)
    silent = [] if ast.get_docstring(tree) else [name]
    silent += [
        full_name
        for full_name, node in public_definitions(tree.body, name)
        if not ast.get_docstring(node) and not is_overload(node)
    ]
    assert not silent, f"no docstring: {', '.join(silent)}"


@pytest.mark.parametrize("path", sources(*PACKAGES), ids=ids)
def test_every_public_signature_is_typed(path: Path) -> None:
    untyped = []
    for name, node in public_definitions(ast.parse(path.read_text()).body, module_name(path)):
        if isinstance(node, ast.ClassDef):
            continue
        given = node.args
        assert given.vararg is None, f"{name}: *args hides what it takes"
        assert given.kwarg is None, f"{name}: **kwargs hides what it takes"
        arguments = [a for a in given.posonlyargs + given.args if a.arg not in ("self", "cls")]
        if node.returns is None or any(a.annotation is None for a in arguments + given.kwonlyargs):
            untyped.append(name)
    assert not untyped, f"not typed: {', '.join(untyped)}"


@pytest.mark.parametrize("path", sources(*WRITTEN_BY_HAND), ids=ids)
def test_no_file_is_too_long_to_hold_one_idea(path: Path) -> None:
    assert len(path.read_text().splitlines()) <= MAX_LINES


def test_the_manifest_names_every_ros_package_that_is_imported() -> None:
    imported = set().union(*map(imported_packages, sources("nlsid_ros")))
    manifest = ElementTree.parse(ROOT / "package.xml").getroot()
    named = {element.text for element in manifest.iter("exec_depend")}
    assert {name for name in imported if ROS.fullmatch(name)} <= named


def test_the_version_is_the_same_everywhere() -> None:
    version = project()["version"]
    package = ElementTree.parse(ROOT / "package.xml").getroot()
    assert package.findtext("version") == version
    headings = re.findall(r"^## (\S+)", (ROOT / "CHANGELOG.md").read_text(), re.MULTILINE)
    assert version in headings[:2], "the newest release, below Unreleased if there is one"


def project() -> dict[str, Any]:
    table: dict[str, Any] = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    return table
