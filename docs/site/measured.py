"""The page of all benchmarks, and figures in other pages, from what `make benchmarks` writes."""

import ast
import json
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from benchmarks.__main__ import BENCHMARKS

LONGEST = 48  # characters of one value
SPACE, HYPHEN = "\N{NO-BREAK SPACE}", "\N{NON-BREAKING HYPHEN}"
THOUSANDS = 1e4  # numbers from here on have no digits behind the point
FEWEST = 3  # figures that make keys with a common beginning a table
RESULTS = Path(__file__).with_name("results.txt")  # what a newcomer reads first
FIGURE = re.compile(r"\{\{(\w+) ([\w.]+) ([\w.]+)\}\}")


def page(results: Path, benchmarks: Path) -> str:
    """Markdown: a table of all files in `results`, and a section for each.

    benchmarks: the folder of the modules, whose docstrings say what is measured beside what.
    """
    files = [(path.stem, json.loads(path.read_text())) for path in sorted(results.glob("*.json"))]
    lines = [
        "# Benchmarks",
        "",
        *RESULTS.read_text(encoding="utf-8").splitlines(),
        "",
        "## All of them",
        "",
        "These figures are written by `make benchmarks`, each with its date, machine and commit. A",
        "program that is compared with (*peers*) ran in the same run, each on one thread. Figures",
        "that were published elsewhere are in the descriptions. Seconds are wall-clock time unless",
        "the key says otherwise. *load* is how many programs wanted the machine's cores when the",
        "benchmark began and when it ended (- where it was not recorded); if they were more than",
        "its cores, seconds are too long. Words are in the [glossary](glossary.md).",
        "",
    ]
    if not files:
        return "\n".join([*lines, "No results lie in benchmarks/results of this checkout.", ""])
    lines += [
        "| what is measured | on | took | load | peers |",
        "|---|---|---|---|---|",
    ]
    for name, found in files:
        load = found.get("load", "-")
        title, _ = _docstring(_module(found, benchmarks))
        lines.append(
            f"| [{title.rstrip('.')}](#{name.replace('_', '-')}) | "
            f"{found['date'][:10].replace('-', HYPHEN)} | {found['seconds']:g}{SPACE}s | "
            f"{f'{SPACE}to{SPACE}'.join(map(str, load))} | {_peers(found['result'])} |"
        )
    if without := sorted(BENCHMARKS.keys() - dict(files).keys()):
        lines += ["", f"Not measured on this checkout: {', '.join(without)}. To measure one:", ""]
        lines += ["    python -m benchmarks NAME"]
    for name, found in files:
        title, rest = _docstring(_module(found, benchmarks))
        lines += ["", f"({name.replace('_', '-')})=", f"## {name}", "", title, ""]
        if rest:
            lines += ["```text", rest, "```", ""]
        command = " ".join(str(word) for word in found["command"])
        lines += [f"`{command}` on {found['machine']}, commit {found['commit'][:8]}:"]
        lines += _tables({key: of for key, of in found["result"].items() if key != "peers"})
    return "\n".join([*lines, ""])


def filled(text: str, results: Path) -> str:
    """The page with figures in the place of `{{benchmark key.key format}}`; - where one is missing.

    A benchmark's figures are in results/benchmark.json; format is Python's, `.2f`.
    """

    def figure(match: re.Match[str]) -> str:
        path = results / f"{match[1]}.json"
        value: Any = json.loads(path.read_text())["result"] if path.is_file() else None
        for key in match[2].split("."):
            value = value.get(key) if isinstance(value, dict) else None
        return "-" if value is None else format(value, match[3])

    return FIGURE.sub(figure, text)


def _module(found: dict[str, Any], benchmarks: Path) -> Path:
    """The file of the benchmark that wrote these figures."""
    return benchmarks / f"{str(found['command'][2]).removeprefix('benchmarks.')}.py"


def _docstring(module: Path) -> tuple[str, str]:
    text = ast.get_docstring(ast.parse(module.read_text())) or ""
    title, _, rest = text.partition("\n")
    return title, rest.strip()


def _peers(result: Any) -> str:
    peers = result.get("peers", {}) if isinstance(result, dict) else {}
    return ", ".join(f"{name} {version}" for name, version in peers.items())


def _tables(result: dict[str, Any], title: str = "") -> Iterator[str]:
    """Figures as lines of Markdown: what is alike side by side, the rest as keys and values."""
    result = _gathered(result)
    single = [[key, of] for key, of in result.items() if not _is_group(of)]
    if single:
        yield from _table(title, ["", "value"], single)
    groups = {key: of for key, of in result.items() if _is_group(of)}
    flat = {
        key: of
        for key, of in groups.items()
        if isinstance(of, dict) and not any(map(_is_group, of.values()))
    }
    for family in _families(flat):
        keys = list(dict.fromkeys(key for of in family.values() for key in of))
        if len(family) == 1:
            (name, of), *_ = family.items()
            yield from _table(_under(title, name), ["", "value"], [[k, of[k]] for k in keys])
        elif len(family) <= len(keys):
            rows = [[k, *(of.get(k) for of in family.values())] for k in keys]
            yield from _table(title, ["", *family], rows)
        else:
            rows = [[name, *(of.get(k) for k in keys)] for name, of in family.items()]
            yield from _table(title, ["", *keys], rows)
    for name, of in groups.items():
        if isinstance(of, list):
            keys = list(dict.fromkeys(key for row in of for key in row))
            rows = [[row.get(k) for k in keys] for row in of]
            yield from _table(_under(title, name), keys, rows)
        elif name not in flat:
            yield from _tables(of, _under(title, name))


def _under(title: str, name: str) -> str:
    return f"{title}, {name}" if title else name


def _is_group(value: Any) -> bool:
    """A dictionary, or a list of dictionaries, with something in it."""
    inner = value if isinstance(value, list) else [value]
    return bool(inner) and all(isinstance(entry, dict) and entry for entry in inner)


def _gathered(result: dict[str, Any]) -> dict[str, Any]:
    """Keys `a_x, a_y, a_z, b_x, b_y, b_z` as a: {x, y, z} and b: {x, y, z}."""
    endings: dict[str, list[str]] = {}
    for key in result:
        words = key.split("_") if not _is_group(result[key]) else []
        for k in range(1, len(words)):
            endings.setdefault("_".join(words[:k]), []).append("_".join(words[k:]))
    alike: dict[frozenset[str], list[str]] = {}
    for beginning, found in endings.items():
        if len(found) >= FEWEST:
            alike.setdefault(frozenset(found), []).append(beginning)
    gathered = dict(result)
    shared = {ends: begins for ends, begins in alike.items() if len(begins) > 1}
    for ends, begins in sorted(shared.items(), key=lambda of: -len(of[0]) * len(of[1])):
        for beginning in begins:
            if all(f"{beginning}_{ending}" in gathered for ending in ends):
                gathered[beginning] = {
                    ending: gathered.pop(f"{beginning}_{ending}") for ending in endings[beginning]
                }
    return gathered


def _families(groups: dict[str, dict[str, Any]]) -> list[dict[str, dict[str, Any]]]:
    """Groups that share half of their keys or more stand in one table."""
    families: list[dict[str, dict[str, Any]]] = []
    for name, of in groups.items():
        for family in families:
            first = next(iter(family.values()))
            if 2 * len(first.keys() & of.keys()) >= max(len(first), len(of)):
                family[name] = of
                break
        else:
            families.append({name: of})
    return families


def _table(title: str, head: list[str], rows: list[list[Any]]) -> Iterator[str]:
    """Its lines, the title above it; the first column names the rows."""
    yield from ("", f"**{_words(title)}**") if title else ()
    yield from ("", f"| {' | '.join(map(_words, head))} |", "|---" * len(head) + "|")
    for first, *cells in rows:
        name = _words(first) if isinstance(first, str) else _shown(first)
        yield f"| {name} | {' | '.join(map(_shown, cells))} |"


def _words(key: str) -> str:
    return _shown(key.replace("_", " ")) if key else ""


def _shown(value: Any) -> str:
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, int | float):
        return f"{value:,.0f}" if abs(value) >= THOUSANDS else f"{value:.4g}"
    if isinstance(value, list):
        text = ", ".join(str(of) if isinstance(of, str) else _shown(of) for of in value)
    else:
        text = str(value or "-")
    text = text if len(text) <= LONGEST else f"{text[: LONGEST - 4]} ..."
    return text.replace("|", "\\|").replace("\n", " ")
