"""A proposed configuration as YAML in which every key says what it is for and why it is so."""

import json
import textwrap
from collections.abc import Iterator, Mapping
from typing import Any, Final

from bags.chain.config import Config
from bags.chain.sections import Key, Section, sections_in
from bags.chain.templates import TEMPLATES, option_texts
from bags.setup.proposal import Proposal
from nlsid_core.identification import METHODS, LeastSquares

WIDTH: Final = 110
HEAD: Final = (
    "Written by nlsid init; every key is listed in docs/configuration.md. SI units, seconds."
)


def yaml_text(proposal: Proposal) -> str:
    """The whole file; what the later steps will meet stands at its head."""
    expected = proposal.expectation
    minded = (f"Mind: {wall}" for wall in dict.fromkeys([*proposal.doubts, *proposal.walls]))
    said = (HEAD, f"{expected[0].upper()}{expected[1:]}.", *minded)
    lines = [line for text in said for line in _comment(text)]
    return "\n".join([*lines, *_section(proposal.content, Config, proposal.why, 0)]) + "\n"


def _section(
    content: Mapping[str, Any], kind: type[Section] | None, why: Mapping[str, str], depth: int
) -> Iterator[str]:
    indent = "  " * depth
    known = kind.keys() if kind is not None else _options(content)
    for key, value in content.items():
        inner = sections_in(kind.model_fields[key].annotation) if kind is not None else []
        if depth == 0:
            yield ""
        yield from _comment(_said(known.get(key), why.get(key, "")), indent)
        if isinstance(value, dict):
            yield f"{indent}{key}:"
            yield from _section(value, inner[0] if inner else None, why, depth + 1)
        elif isinstance(value, list) and value and isinstance(value[0], dict):
            yield f"{indent}{key}:"
            for entry in value:
                yield from _comment(why.get(entry.get("path", ""), ""), indent + "  ")
                pairs = ", ".join(f"{k}: {_flow(v)}" for k, v in entry.items())
                yield f"{indent}  - {{{pairs}}}"
        else:
            yield from _wrapped(f"{indent}{key}: {_flow(value)}", f"{indent}  ", value)


def _options(content: Mapping[str, Any]) -> dict[str, Key]:
    """The keys of the section `identification`: of its class of models, and of its method."""
    method = METHODS.get(content.get("method", ""), LeastSquares)  # which has no options
    texts = TEMPLATES[content["model"]].texts() | option_texts(method)
    return {"model": Key("the class of models"), "method": Key("how the model is found")} | {
        key: Key(said) for key, said in texts.items()
    }


def _said(key: Key | None, why: str) -> str:
    text = "" if key is None else f"{key.text} [{key.unit}]" if key.unit else key.text
    return "; ".join(part for part in (text, why) if part)


def _comment(text: str, indent: str = "") -> Iterator[str]:
    yield from textwrap.wrap(
        " ".join(text.split()),
        WIDTH,
        initial_indent=f"{indent}# ",
        subsequent_indent=f"{indent}#   ",
    )


def _wrapped(line: str, indent: str, value: Any) -> Iterator[str]:
    """A list goes on in the next line."""
    width = WIDTH if isinstance(value, list) else len(line)
    yield from textwrap.wrap(
        line, width, subsequent_indent=indent, break_long_words=False, break_on_hyphens=False
    )


def _flow(value: Any) -> str:
    if isinstance(value, str) and value.replace("_", "").isalpha():
        return value
    return json.dumps(value, ensure_ascii=False)
