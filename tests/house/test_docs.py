"""The map of the house and its glossary are true, and every page leads to them."""

import importlib
import inspect
import json
import re
from pathlib import Path

from benchmarks.__main__ import BENCHMARKS
from docs.site import api, linking, measured
from tests.house.sources import ROOT

DOCS = ROOT / "docs"
WALK = 12  # files at most


def test_every_walk_names_a_dozen_files_at_most_and_each_is_there() -> None:
    walks = (DOCS / "architecture.md").read_text().split("\n## Walk ")[1:]
    assert len(walks) == 3
    for walk in walks:
        named = re.findall(r"`((?:nlsid_core|bags|nlsid_ros)/[\w/]+\.py)`", walk)
        assert 5 <= len(named) <= WALK, walk
        assert not [name for name in named if not (ROOT / name).is_file()]


def test_every_room_of_the_core_is_on_the_map() -> None:
    page = (DOCS / "architecture.md").read_text()
    rooms = [p.stem for p in (ROOT / "nlsid_core").iterdir() if p.stem[0] not in "_."]
    assert not [room for room in rooms if room != "py" and room not in page]


def test_every_page_leads_to_the_glossary() -> None:
    pages = [page for page in DOCS.glob("*.md") if page.name != "glossary.md"]
    assert not [page.name for page in pages if "glossary.md" not in page.read_text()]


def test_every_link_of_a_page_leads_somewhere() -> None:
    broken = [
        f"{page.relative_to(ROOT)}: {target}"
        for page in [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *DOCS.rglob("*.md")]
        for target in re.findall(r"\]\(([\w./-]+\.\w+)[#)]", page.read_text())
        if not (page.parent / target).exists()
        and not target.startswith("run/")  # a block of the page makes it when the site is built
        and target != "benchmarks.md"  # written then, too
    ]
    assert not broken


def test_every_test_that_a_page_names_is_there() -> None:
    named = [
        (page.relative_to(ROOT), name)
        for page in [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *DOCS.rglob("*.md")]
        for name in re.findall(r"\btests(?:/\w+)+\.py", page.read_text())
    ]
    assert named
    assert not [found for found in named if not (ROOT / found[1]).is_file()]


def test_what_the_pages_of_theory_name_is_there() -> None:
    pages = sorted(DOCS.glob("theory*.md"))
    assert len(pages) > 2
    assert not {page.name: found for page in pages if (found := linking.unknown(page.read_text()))}


def test_what_states_the_source_of_its_formula_is_linked_from_the_page_that_derives_it(
    tmp_path: Path,
) -> None:
    """A class or function that says so, or for a module any name in it."""
    documented = api.write(tmp_path)
    pages = [page for page in DOCS.glob("*.md") if linking.derives(page.stem)]
    linked = {name for page in pages for name in linking.linked(page.read_text(), documented)[1]}
    without = []
    for room in api.ROOMS:
        for module in api.modules(importlib.import_module(f"nlsid_core.{room}")):
            here = module.__name__
            things = {here: module} | {
                f"{here}.{n}": getattr(module, n) for n in api.members(module)
            }
            without += [
                name
                for name, thing in things.items()
                if "Source: " in (inspect.getdoc(thing) or "")
                and not any(f"{link}.".startswith(f"{name}.") for link in linked)
            ]
    assert len(linked) > 100
    assert not without


def test_figures_of_pages_are_what_the_benchmarks_wrote(tmp_path: Path) -> None:
    (tmp_path / "satellite.json").write_text(json.dumps({"result": {"n1": {"rho": 11.26}}}))
    page = "{{satellite n1.rho .1f}} s, {{satellite n1.other d}}, {{kernel n1 d}}"
    assert measured.filled(page, tmp_path) == "11.3 s, -, -"


def test_figures_that_are_alike_stand_side_by_side(tmp_path: Path) -> None:
    result = {
        "seconds_10": 0.5,
        "seconds_20": 1.25,
        "seconds_40": 25817.3,
        "gib_10": 1,
        "gib_20": 2,
        "gib_40": 4,
        "proved": True,
        "n1": {"first": 9.0, "last": 8.0},
        "n2": {"first": 7.0, "last": None},
        "rows": [{"robot": "arm|left", "widths": [0.1, 0.2]}],
        "differ": {},
        "peers": {"drake": "1.51.1"},
    }
    written = {
        "command": ["python", "-m", "benchmarks.kernel"],
        "date": "2026-11-23T09:00",
        "machine": "one",
        "commit": "0" * 40,
        "seconds": 2,
        "result": result,
    }
    (tmp_path / "kernel.json").write_text(json.dumps(written))
    tables = measured.page(tmp_path, ROOT / "benchmarks").partition("on one, commit 00000000:")[2]
    rows = [line for line in tables.splitlines() if line and not line.startswith("|---")]
    assert rows == [
        "|  | value |",
        "| proved | yes |",
        "| differ | - |",
        "|  | n1 | n2 |",
        "| first | 9 | 7 |",
        "| last | 8 | - |",
        "|  | seconds | gib |",
        "| 10 | 0.5 | 1 |",
        "| 20 | 1.25 | 2 |",
        "| 40 | 25,817 | 4 |",
        "**rows**",
        "| robot | widths |",
        "| arm\\|left | 0.1, 0.2 |",
    ]


def test_a_figure_of_a_page_names_a_benchmark_and_a_key_that_its_file_has() -> None:
    results = ROOT / "benchmarks" / "results"
    named = [
        found for page in DOCS.glob("*.md") for found in measured.FIGURE.finditer(page.read_text())
    ]
    assert len(named) > 50
    assert {found[1] for found in named} <= set(BENCHMARKS)
    empty = [
        found[0]
        for found in named
        if (results / f"{found[1]}.json").is_file() and measured.filled(found[0], results) == "-"
    ]
    assert not empty


def test_no_result_names_a_folder_of_the_machine_it_was_measured_on() -> None:
    commands = [
        json.loads(path.read_text())["command"]
        for path in (ROOT / "benchmarks" / "results").glob("*.json")
    ]
    assert commands
    assert not [word for command in commands for word in command if word.startswith("/")]
