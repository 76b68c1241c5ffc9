"""The project's own source files, parsed once, and what each of them imports."""

import ast
import gc
import re
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache, cached_property
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
PACKAGES = ("nlsid_core", "bags", "nlsid_ros", "nlsid")
ROS = re.compile(
    r"rcl\w*|ros\w*_runtime_py|\w+_(msgs|srvs|interfaces)|ament_\w+|launch(_ros)?|tf2\w*"
)


@dataclass(frozen=True)
class Import:
    """`import module`, or `from module import name`; both in full."""

    module: str
    name: str | None
    line: int

    @property
    def package(self) -> str:
        """The first part of the module's name."""
        return self.module.partition(".")[0]


@dataclass(frozen=True)
class Source:
    """A file of Python."""

    path: Path

    def __str__(self) -> str:
        return str(self.path.relative_to(ROOT))

    @property
    def parts(self) -> tuple[str, ...]:
        """Of its path, without the suffix: ("nlsid_core", "kernel", "files")."""
        return self.path.relative_to(ROOT).with_suffix("").parts

    @property
    def name(self) -> str:
        """As it is imported."""
        return ".".join(self.parts[:-1] if self.parts[-1] == "__init__" else self.parts)

    @cached_property
    def text(self) -> str:
        """What it says."""
        return self.path.read_text()

    @cached_property
    def tree(self) -> ast.Module:
        """Its syntax."""
        tree = ast.parse(self.text)
        gc.freeze()  # it lives to the end: to look for garbage in all of them takes twice as long
        return tree

    @cached_property
    def imports(self) -> list[Import]:
        """All of them, also those inside functions; relative ones are resolved."""
        return list(self._imports())

    @property
    def packages(self) -> set[str]:
        """Top-level packages that it imports."""
        return {entry.package for entry in self.imports}

    def _imports(self) -> Iterator[Import]:
        for node in self._statements:
            if isinstance(node, ast.Import):
                yield from (Import(alias.name, None, node.lineno) for alias in node.names)
            elif isinstance(node, ast.ImportFrom):
                base = list(self.parts[: -node.level]) if node.level else []
                module = ".".join(base + (node.module.split(".") if node.module else []))
                yield from (Import(module, alias.name, node.lineno) for alias in node.names)

    def has_relative_imports(self) -> bool:
        """Whether there is one."""
        return any(isinstance(n, ast.ImportFrom) and n.level for n in self._statements)

    @cached_property
    def _statements(self) -> list[ast.stmt]:
        """All of them, also those inside others; imports are among them, in no expression."""
        found, left = [], list[ast.AST](self.tree.body)
        while left:
            node = left.pop()
            if isinstance(node, ast.expr):
                continue
            if isinstance(node, ast.stmt):
                found.append(node)
            left += ast.iter_child_nodes(node)
        return found


@cache
def sources(*folders: str) -> tuple[Source, ...]:
    """The files below these folders of the checkout, in order of their names."""
    found = [path for folder in folders for path in sorted((ROOT / folder).rglob("*.py"))]
    return tuple(map(_source, found))


@cache
def _source(path: Path) -> Source:
    return Source(path)


def modules_loaded_by(statement: str) -> set[str]:
    """Modules that a fresh interpreter has after `statement` and did not have before."""
    script = (
        "import sys; before = set(sys.modules)\n"
        f"sys.path.insert(0, {str(ROOT)!r})\n"
        f"{statement}\n"
        "print(*sorted(set(sys.modules) - before), file=sys.stderr)"
    )
    process = subprocess.run(
        [sys.executable, "-c", script], capture_output=True, text=True, check=False, cwd=ROOT
    )
    assert process.returncode == 0, process.stderr
    return set(process.stderr.split())
