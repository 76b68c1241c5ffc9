"""Sphinx's configuration of the site; `make docs` builds it, docs/site/ holds what it runs."""

import sys
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

from docs.site import api, linking, measured, running  # noqa: E402

project = "nlsid"
author = "the nlsid maintainers"
copyright = "the nlsid maintainers, Apache-2.0"
extensions = ["myst_parser", "sphinx.ext.autodoc"]
source_suffix = {".md": "markdown"}
exclude_patterns = ["site"]
myst_heading_anchors = 3
myst_enable_extensions = ["attrs_inline", "colon_fence"]
nitpicky = False
autodoc_typehints = "signature"
autodoc_member_order = "bysource"
python_maximum_signature_line_length = 80
add_module_names = False
html_theme = "furo"
html_title = "nlsid"
html_static_path = ["static"]
html_css_files = ["nlsid.css"]
html_copy_source = False
html_theme_options = {"navigation_with_keys": True}

PAGES = ROOT / "build" / "pages"  # where blocks run
_documented: set[str] = set()
_derived: dict[str, list[str]] = {}


def _prepare(app: Any) -> None:
    _documented.update(api.write(Path(app.srcdir) / "api"))
    results = measured.page(ROOT / "benchmarks" / "results", ROOT / "benchmarks")
    (Path(app.srcdir) / "benchmarks.md").write_text(results)
    pages = [page for page in Path(app.srcdir).glob("*.md") if linking.derives(page.stem)]
    for page in sorted(pages):
        for name in linking.linked(page.read_text(), _documented)[1]:
            _derived.setdefault(name, []).append(page.stem)


def _read(app: Any, name: str, source: list[str]) -> None:
    if name.startswith("decisions/0"):
        source[0] = f"---\norphan: true\n---\n{source[0]}"
    if linking.derives(name):
        source[0] = linking.linked(source[0], _documented)[0]
    source[0] = measured.filled(source[0], ROOT / "benchmarks" / "results")
    if running.FRONT.match(source[0]):
        folder = PAGES / name.replace("/", "-")
        page = running.run_page(source[0], folder, ROOT)
        source[0] = running.pictures(page, folder, Path(app.srcdir) / "pictures")


def _docstring(*arguments: Any) -> None:
    _, _, name, _, _, lines = arguments
    lines[:] = api.literal(lines)
    for page in _derived.get(name, []):
        lines += ["", f"Derived in :doc:`/{page}`."]


def _signature(*arguments: Any) -> tuple[str | None, str | None]:
    *_, taken, returned = arguments
    return taken and api.short(taken), returned and api.short(returned)


def setup(app: Any) -> None:
    """Connect what the site adds."""
    app.connect("builder-inited", _prepare)
    app.connect("source-read", _read)
    app.connect("autodoc-process-docstring", _docstring)
    app.connect("autodoc-process-signature", _signature)
