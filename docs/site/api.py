"""Pages of the API, made from the docstrings: one for each room of nlsid_core, and for bags."""

import importlib
import inspect
import pkgutil
import re
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType

import nlsid

ROOMS = (
    "identification",
    "design",
    "models",
    "policies",
    "funnels",
    "running",
    "dynamics",
    "data",
    "polynomial",
    "sos",
    "kernel",
    "designs",
    "proofs",
    "documents",
)

ARRAY = re.compile(
    r"(?:numpy\.)?ndarray\[tuple\[Any, \.\.\.\], (?:numpy\.)?dtype\[[\w.\[\]]*?\]+\]"
)
FUNCTION = re.compile(r"<function (\w+)(?: at 0x[0-9a-f]+)?>")
INDEX = """# API

Made from the docstrings. Nouns are frozen dataclasses and arrays, verbs are functions.

```{toctree}
:maxdepth: 1

"""


def modules(package: ModuleType) -> Iterator[ModuleType]:
    """The package and all public modules in it: first a verb's, then what else it offers."""
    yield package
    offered = {
        getattr(package, name).__module__
        for name in getattr(package, "__all__", ())
        if hasattr(getattr(package, name), "__module__")
    }
    names = [
        found.name
        for found in pkgutil.walk_packages(getattr(package, "__path__", []), f"{package.__name__}.")
        if not any(part.startswith("_") for part in found.name.split("."))
    ]
    verbs = {f"{package.__name__}.{name}" for name in getattr(package, "__all__", ())}
    for name in sorted(names, key=lambda name: (name not in verbs, name not in offered, name)):
        yield importlib.import_module(name)


def members(module: ModuleType) -> list[str]:
    """Public classes and functions that the module itself defines, as the API shows them."""
    return [
        name
        for name, thing in vars(module).items()
        if not name.startswith("_")
        and (inspect.isclass(thing) or inspect.isfunction(thing))
        and thing.__module__ == module.__name__
    ]


def write(folder: Path) -> set[str]:
    """Write a page for each room into `folder`; returns the full names of what they document."""
    folder.mkdir(parents=True, exist_ok=True)
    documented: set[str] = set()
    for room in ROOMS:
        page = [f"# nlsid_core.{room}\n"]
        package = importlib.import_module(f"nlsid_core.{room}")
        for module in modules(package):
            names = members(module)
            if not names and module is not package:
                continue
            if module is not package:
                page.append(f"## {module.__name__.removeprefix(f'nlsid_core.{room}.')}\n")
            page.append(f"```{{eval-rst}}\n.. automodule:: {module.__name__}\n```\n")
            for name in names:
                thing = getattr(module, name)
                kind = "class" if inspect.isclass(thing) else "function"
                options = "\n   :members:" if kind == "class" else ""
                page.append(
                    f"```{{eval-rst}}\n.. auto{kind}:: {module.__name__}.{name}{options}\n```\n"
                )
                documented.update((module.__name__, f"{module.__name__}.{name}"))
                if kind == "class":
                    documented.update(
                        f"{module.__name__}.{name}.{member}"
                        for member in vars(thing)
                        if not member.startswith("_") and inspect.getdoc(vars(thing)[member])
                    )
        _update(folder / f"{room}.md", "\n".join(page))
    _update(folder / "nlsid.md", _face(documented))
    _update(folder / "index.md", INDEX + "\n".join(("nlsid", *ROOMS)) + "\n```\n")
    return documented


def _face(documented: set[str]) -> str:
    """The page of what `import nlsid` gives: a table, and what no room of the core documents."""
    rows, others = [], []
    for name in nlsid.__all__:
        thing = getattr(nlsid, name)
        full = f"{thing.__module__}.{thing.__name__}"
        kind = "class" if inspect.isclass(thing) else "function"
        role = "class" if kind == "class" else "func"
        first = (inspect.getdoc(thing) or "").partition("\n\n")[0].replace("\n", " ")
        rows.append(f"| {{py:{role}}}`{name} <{full}>` | {first.replace('|', chr(92) + '|')} |")
        if full not in documented:
            others.append(f"```{{eval-rst}}\n.. auto{kind}:: {full}\n```\n")
    head = "# nlsid\n\nWhat `import nlsid` gives. A name is imported when it is first used.\n"
    table = "\n".join(["| name | what |", "|---|---|", *rows])
    return "\n".join([head, table, "\n## Bags and pictures\n", *others])


def short(signature: str) -> str:
    """A signature with arrays, and functions as defaults, named as they are in the source."""
    return FUNCTION.sub(r"\1", ARRAY.sub("Array", signature))


def literal(lines: list[str]) -> list[str]:
    """A docstring, which is plain text, as reStructuredText that says the same.

    Code in backticks stays code, lines that are set in (equations, tables) keep their places.
    """
    marked: list[str] = []
    inside = False
    for line in lines:
        indented = line.startswith((" ", "\t"))
        if indented and not inside:
            marked += ["", "::", ""]
        elif not indented and inside and line.strip():
            marked.append("")
        if line.strip():
            inside = indented
        marked.append(line if indented else _escaped(line))
    return marked


def _escaped(line: str) -> str:
    parts = re.split(r"(`[^`]+`)", line)
    return "".join(
        f"``{part[1:-1]}``" if i % 2 else re.sub(r"([\\*|_`])", r"\\\1", part)
        for i, part in enumerate(parts)
    )


def _update(path: Path, text: str) -> None:
    """Write only what changed, so that Sphinx builds only that again."""
    if not path.is_file() or path.read_text() != text:
        path.write_text(text)
