"""Links between pages of theory or of certificates and the functions that they derive.

In such a page, code such as `design.tube.design_output_tube` that names something of
nlsid_core becomes a link to its entry in the API, and that entry links back to the page.
"""

import importlib
import re
from functools import cache

CODE = re.compile(r"(?<!`)`([A-Za-z_]\w*(?:\.\w+)*)(?:\([^`]*\))?`(?!`)")
ROOMS = (
    "",
    "identification.",
    "models.",
    "design.",
    "dynamics.",
    "identification.polynomial.monotone_rie.",
)


def derives(page: str) -> bool:
    """Whether functions are derived in the page of that name."""
    return page.startswith(("theory", "certificate", "sums_of_squares"))


@cache
def home(name: str) -> str | None:
    """What such a page calls `name`: nlsid_core.module or nlsid_core.module.Name, or None.

    A field of a dataclass leads to its class.
    """
    if "." not in name and not name[0].isupper():
        return None
    return next((found for room in ROOMS if (found := _found(f"nlsid_core.{room}{name}"))), None)


def _found(path: str) -> str | None:
    module, _, name = path.rpartition(".")
    try:
        return importlib.import_module(path).__name__
    except ImportError:
        pass
    try:
        holder: object = importlib.import_module(module)
    except ImportError:
        above, _, owner = module.rpartition(".")
        if not above:
            return None
        try:
            holder = getattr(importlib.import_module(above), owner)
        except (ImportError, AttributeError):
            return None
    thing = getattr(holder, name, None)
    if thing is None and name in getattr(holder, "__annotations__", {}):
        thing = holder
    where, what = getattr(thing, "__module__", None), getattr(thing, "__qualname__", None)
    return f"{where}.{what}" if what and str(where).startswith("nlsid_core") else None


def linked(text: str, documented: set[str]) -> tuple[str, set[str]]:
    """The page with links in the place of names, and what it links to."""
    named: set[str] = set()

    def link(match: re.Match[str]) -> str:
        target = home(match[1])
        if target is None:
            return match[0]
        if target not in documented:
            target = target.rpartition(".")[0]
        if target not in documented:
            return match[0]
        named.add(target)
        return f"{{py:obj}}`{match[1]} <{target}>`"

    return CODE.sub(link, text), named


def unknown(text: str) -> list[str]:
    """Code of the page that reads like a name of the core and is none."""
    return [
        name
        for name in CODE.findall(text)
        if "." in name
        and not name.startswith(("np.", "examples.", "nlsid_core"))
        and not home(name)
    ]
