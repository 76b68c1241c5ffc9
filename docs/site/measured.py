"""The page of all benchmarks, and figures in other pages, from what `make benchmarks` writes."""

import ast
import json
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from benchmarks.__main__ import BENCHMARKS

LONGEST = 48  # characters of one value
DEPTH = 3  # of keys in keys
FIGURE = re.compile(r"\{\{(\w+) ([\w.]+) ([\w.]+)\}\}")


def page(results: Path, benchmarks: Path) -> str:
    """Markdown: a table of all files in `results`, and a section for each.

    benchmarks: the folder of the modules, whose docstrings say what is measured beside what.
    """
    files = [(path.stem, json.loads(path.read_text())) for path in sorted(results.glob("*.json"))]
    lines = [
        "# Benchmarks",
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
        "| benchmark | measured | took | load | commit | peers |",
        "|---|---|---|---|---|---|",
    ]
    for name, found in files:
        lines.append(
            f"| [{name}](#{name.replace('_', '-')}) | {found['date'][:10]} | "
            f"{found['seconds']:g} s | {' to '.join(map(str, found.get('load', '-')))} | "
            f"{found['commit'][:8]} | {_peers(found['result'])} |"
        )
    if without := sorted(BENCHMARKS.keys() - dict(files).keys()):
        lines += ["", f"Not measured on this checkout: {', '.join(without)}. To measure one:", ""]
        lines += ["    python -m benchmarks NAME"]
    for name, found in files:
        module = str(found["command"][2]).removeprefix("benchmarks.")
        title, rest = _docstring(benchmarks / f"{module}.py")
        lines += ["", f"({name.replace('_', '-')})=", f"## {name}", "", title, ""]
        if rest:
            lines += ["```text", rest, "```", ""]
        command = " ".join(str(word) for word in found["command"])
        lines += [f"`{command}` on {found['machine']}:", "", "| key | value |", "|---|---|"]
        lines += [f"| {key} | {value} |" for key, value in _flat(found["result"], "", DEPTH)]
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


def _docstring(module: Path) -> tuple[str, str]:
    text = ast.get_docstring(ast.parse(module.read_text())) or ""
    title, _, rest = text.partition("\n")
    return title, rest.strip()


def _peers(result: Any) -> str:
    peers = result.get("peers", {}) if isinstance(result, dict) else {}
    return ", ".join(f"{name} {version}" for name, version in peers.items())


def _flat(value: Any, key: str, depth: int) -> Iterator[tuple[str, str]]:
    if isinstance(value, dict) and depth:
        for name, inner in value.items():
            yield from _flat(inner, f"{key}.{name}" if key else str(name), depth - 1)
    else:
        yield key.replace("|", "\\|") or "result", _shown(value)


def _shown(value: Any) -> str:
    if isinstance(value, float):
        return f"{value:.4g}"
    text = value if isinstance(value, str) else json.dumps(value)
    text = text.replace("|", "\\|").replace("\n", " ")
    return text if len(text) <= LONGEST else f"{text[: LONGEST - 4]} ..."
