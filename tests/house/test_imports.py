"""Who may import whom."""

import ast
import re
import subprocess
import sys
from graphlib import CycleError, TopologicalSorter
from importlib import import_module
from pathlib import Path

import pytest

import nlsid
from tests.house.sources import PACKAGES, ROOT, ROS, Source, modules_loaded_by, sources

# Each package may import itself and those before it.
DOWNWARD = {
    "nlsid_core": {"nlsid_core"},
    "bags": {"nlsid_core", "bags"},
    "nlsid_ros": {"nlsid_core", "bags", "nlsid_ros"},
    "nlsid": {"nlsid_core", "bags"},  # hands names on, and nothing inside uses it
}
# The rooms of bags, each standing on those before it.
ROOMS = (
    "recordings",
    "signals",
    "tools",
    "designs",
    "monitoring",
    "viewing",
    "pictures",
    "chain",
    "fleet",
    "setup",
    "commands",
)
# The rooms of nlsid_core by band, and the bands that each may import.
BANDS = {
    "search": {"identification", "design", "sos", "conic"},
    "run": {"running", "designs"},
    "nouns": {"funnels", "policies", "models", "dynamics", "data", "polynomial"}
    | {"documents", "proofs"},
    "base": {"errors", "arrays", "files", "options", "progress", "native", "shown"},
    "kernel": {"kernel"},
}
BELOW = {
    "search": {"search", "run", "nouns", "base", "kernel"},
    "run": {"run", "nouns", "base", "kernel"},
    "nouns": {"nouns", "base", "kernel"},
    "base": {"base"},
    "kernel": {"kernel"},
}
SOLVERS = {"clarabel", "cvxpy"}
SOLVERS_KNOWN_TO = {
    "nlsid_core/conic.py": SOLVERS,
    "nlsid_core/design/tube_program.py": {"cvxpy"},  # a few small ones a funnel
}
BAG_FORMATS = {"rosbags", "mcap"}


def room(source: Source) -> str:
    return source.parts[1]


def band(room: str) -> str | None:
    return next((name for name, rooms in BANDS.items() if room in rooms), None)


def core_rooms_imported_by(source: Source) -> set[str]:
    rooms = set()
    for entry in source.imports:
        path = [*entry.module.split("."), *([entry.name] if entry.name else [])]
        if path[0] == "nlsid_core" and len(path) > 1:
            rooms.add(path[1])
    return rooms


def is_kernel(source: Source) -> bool:
    return source.parts[:2] == ("nlsid_core", "kernel")


def test_imports_go_only_downward_between_the_packages() -> None:
    upward = [
        f"{source}: {name}"
        for source in sources(*PACKAGES)
        for name in sorted((source.packages & set(PACKAGES)) - DOWNWARD[source.parts[0]])
    ]
    assert not upward


def test_a_room_of_bags_knows_only_the_rooms_below_it() -> None:
    upward = []
    for source in sources(*(f"bags/{name}" for name in ROOMS)):
        above = ROOMS[ROOMS.index(room(source)) + 1 :]
        upward += [
            f"{source}:{entry.line}: {entry.module}"
            for entry in source.imports
            if entry.package == "bags" and entry.module.split(".")[1:2] in [[a] for a in above]
        ]
    assert not upward


def test_a_band_of_the_core_knows_only_the_bands_below_it() -> None:
    upward = []
    for source in sources("nlsid_core"):
        mine = band(room(source))
        if mine is not None:
            upward += [
                f"{source} ({mine}): {name}"
                for name in sorted(core_rooms_imported_by(source))
                if band(name) not in {None, *BELOW[mine]}
            ]
    assert not upward


def test_no_modules_of_the_core_import_each_other_in_a_circle() -> None:
    modules = {source.name: source for source in sources("nlsid_core") if band(room(source))}
    graph: dict[str, set[str]] = {}
    for name, source in modules.items():
        targets = set()
        for entry in source.imports:
            whole = f"{entry.module}.{entry.name}"
            targets.add(whole if whole in modules else entry.module)
        graph[name] = (targets & set(modules)) - {name}
    try:
        list(TopologicalSorter(graph).static_order())
    except CycleError as error:
        raise AssertionError(" -> ".join(error.args[1])) from None


def test_nothing_private_is_used_outside_its_package() -> None:
    offenders = []
    for source in sources(*PACKAGES, "examples", "benchmarks"):
        package = source.name if source.parts[-1] == "__init__" else source.name.rpartition(".")[0]
        foreign = [e for e in source.imports if e.module.rpartition(".")[0] != package]
        for entry in foreign:
            path = [*entry.module.split("."), *([entry.name] if entry.name else [])]
            inner = entry.module.startswith("rclpy.impl")  # rclpy's own, without an underscore
            if inner or any(p.startswith("_") and not p.startswith("__") for p in path):
                offenders.append(f"{source}:{entry.line}: {'.'.join(path)}")
        modules = {
            entry.name
            for entry in foreign
            if entry.package in PACKAGES
            and any(
                (ROOT / Path(*entry.module.split("."), f"{entry.name}{end}")).exists()
                for end in (".py", "")
            )
        }
        offenders += [
            f"{source}:{node.lineno}: {node.value.id}.{node.attr}"
            for node in ast.walk(source.tree)
            if isinstance(node, ast.Attribute)
            and node.attr.startswith("_")
            and not node.attr.startswith("__")
            and isinstance(node.value, ast.Name)
            and node.value.id in modules
        ]
    assert not offenders


def test_modules_are_named_in_full_except_in_the_kernel() -> None:
    """The kernel also runs as a folder on its own, so it knows no name of its own."""
    everywhere = sources(*PACKAGES, "examples", "benchmarks", "tests")
    assert not [
        str(source)
        for source in everywhere
        if source.has_relative_imports() and not is_kernel(source)
    ]


def test_the_kernel_imports_the_standard_library_and_itself_only() -> None:
    allowed = {"nlsid_core", *sys.stdlib_module_names}
    foreign = []
    for source in filter(is_kernel, sources("nlsid_core")):
        for entry in source.imports:
            if entry.package == "nlsid_core" and not entry.module.startswith("nlsid_core.kernel"):
                foreign.append(f"{source}: {entry.module}")
            if entry.package not in allowed:
                foreign.append(f"{source}: {entry.module}")
        absolute = re.findall(r"^\s*(?:from|import) nlsid_core.*", source.text, re.MULTILINE)
        foreign += [f"{source}: {line.strip()}" for line in absolute]
    assert not foreign


def test_the_kernel_runs_as_a_folder_on_a_bare_python(tmp_path: Path) -> None:
    """-I -S: no site packages, no environment, not the current folder."""
    empty = tmp_path / "x.proof.json"
    empty.write_text("{}")
    folder = ROOT / "nlsid_core" / "kernel"
    command = [sys.executable, "-I", "-S", str(folder), str(empty)]
    process = subprocess.run(command, capture_output=True, text=True, check=False, cwd=tmp_path)
    assert process.returncode == 1, process.stderr
    assert process.stdout.startswith(f"{empty}: REJECTED")


def test_each_foreign_library_has_one_owner() -> None:
    offenders = []
    for source in sources(*PACKAGES):
        package, imported = source.parts[0], source.packages
        wrong = (imported & SOLVERS) - SOLVERS_KNOWN_TO.get(str(source), set())
        if package != "bags":
            wrong |= imported & BAG_FORMATS
        if package != "nlsid_ros":
            wrong |= {name for name in imported if ROS.fullmatch(name)}
        offenders += [f"{source}: {name}" for name in sorted(wrong)]
    assert not offenders


def test_the_core_stands_on_numpy_and_the_search_on_scipy() -> None:
    offenders = []
    for source in sources("nlsid_core"):
        allowed = {"numpy", "nlsid_core", *sys.stdlib_module_names}
        if room(source) in BANDS["search"]:
            allowed |= {"scipy"} | SOLVERS_KNOWN_TO.get(str(source), set())
        offenders += [f"{source}: {name}" for name in sorted(source.packages - allowed)]
    assert not offenders


def loaded_by(modules: list[str]) -> set[str]:
    """Top-level packages that a fresh interpreter has after importing `modules`."""
    loaded = modules_loaded_by(f"import {', '.join(modules)}")
    return {name.partition(".")[0] for name in loaded} - set(sys.stdlib_module_names)


def test_checking_and_monitoring_load_nothing_but_numpy() -> None:
    modules = [s.name for s in sources("nlsid_core") if room(s) not in BANDS["search"]]
    modules = [name for name in modules if not name.endswith("__main__")]
    assert {"nlsid_core.kernel", "nlsid_core.models"} <= set(modules)
    assert loaded_by(modules) - loaded_by(["numpy"]) == {"nlsid_core"}


@pytest.mark.slow
def test_the_core_and_the_bags_load_no_ros() -> None:
    modules = [source.name for source in sources("nlsid_core", "bags")]
    loaded = loaded_by([name for name in modules if not name.endswith("__main__")])
    assert "bags" in loaded
    assert not {name for name in loaded if ROS.fullmatch(name)}


HEAVY = {"numpy", "scipy", "matplotlib", "yaml", "rosbags", "mcap", "lz4", "zstandard"} | SOLVERS


def test_importing_the_packages_loads_nothing_else() -> None:
    assert loaded_by(["nlsid_core", "bags"]) == {"nlsid_core", "bags"}
    assert loaded_by(["nlsid_core.kernel"]) == {"nlsid_core"}


def test_the_face_hands_names_on_and_loads_nothing_before_one_is_used() -> None:
    assert loaded_by(["nlsid"]) == {"nlsid"}
    assert 25 <= len(nlsid.__all__) <= 40
    written = sources("nlsid")[0].imports
    said = {entry.name: entry.module for entry in written if entry.package != "typing"}
    for name in nlsid.__all__:
        thing = getattr(nlsid, name)
        there = getattr(thing, "__name__", name)
        assert getattr(import_module(said[there]), there) is thing, name
    with pytest.raises(AttributeError, match="no attribute 'Kalman'"):
        nlsid.Kalman  # noqa: B018


def test_help_and_check_start_without_numpy(tmp_path: Path) -> None:
    (tmp_path / "x.proof.json").write_text("{}")
    for arguments in (["--help"], ["bag", "--help"], ["check", str(tmp_path / "x.proof.json")]):
        loaded = modules_loaded_by(
            "from contextlib import redirect_stdout, suppress\n"
            "import io; from bags.commands.cli import app\n"
            f"with suppress(SystemExit), redirect_stdout(io.StringIO()): app({arguments!r})"
        )
        assert "bags.commands.cli" in loaded
        assert not {name.partition(".")[0] for name in loaded} & HEAVY, arguments
