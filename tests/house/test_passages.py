"""No long passage of nlsid_core stands twice, whatever its names and constants are."""

import ast
from collections import defaultdict
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache

from tests.house.sources import sources

LONGEST = 15  # lines that two passages of the same shape may have
Shape = int  # a hash; equal for equal shapes


@dataclass(frozen=True)
class Block:
    """The statements of one body, what each looks like and how many lines it takes.

    Imports and `__all__` are left out, since lists of names say nothing twice, and so are
    docstrings and sentences that have a name.
    """

    where: str
    lines: tuple[int, ...]  # where each statement begins
    shapes: tuple[Shape, ...]
    lengths: tuple[int, ...]  # in lines


@cache
def shape(node: ast.AST) -> Shape:
    """What is left of a syntax tree without names, constants, annotations and docstrings."""
    children: list[object] = [type(node).__name__]
    for name, value in ast.iter_fields(node):
        if name in ("annotation", "returns", "decorator_list", "ctx", "kind"):
            continue
        if isinstance(value, ast.AST):
            children.append(shape(value))
        elif isinstance(value, list):
            nodes = [entry for entry in value if isinstance(entry, ast.AST)]
            children.append((name, *(shape(entry) for entry in nodes if not _is_text(entry))))
        else:
            children.append(value is None and not isinstance(node, ast.Constant))  # no name
    return hash(tuple(children))


def _is_text(node: ast.AST) -> bool:
    """Whether it is a docstring, or another string that stands alone."""
    return (
        isinstance(node, ast.Expr)
        and isinstance(node.value, ast.Constant)
        and isinstance(node.value.value, str)
    )


def _is_list_of_names(node: ast.stmt) -> bool:
    return isinstance(node, ast.Import | ast.ImportFrom) or (
        isinstance(node, ast.Assign) and ast.unparse(node.targets[0]) == "__all__"
    )


def _is_sentence(node: ast.stmt) -> bool:
    """Whether a name is given to a text."""
    return (
        isinstance(node, ast.Assign)
        and isinstance(node.value, ast.Constant)
        and isinstance(node.value.value, str)
    )


@cache
def _texts(node: ast.AST) -> int:
    """Lines of the docstrings in it."""
    if isinstance(node, ast.Expr):
        return _span(node) if _is_text(node) else 0
    return sum(_texts(n) for n in ast.iter_child_nodes(node) if not isinstance(n, ast.expr))


def _span(node: ast.stmt) -> int:
    return (node.end_lineno or node.lineno) - node.lineno + 1


def blocks(where: str, tree: ast.Module) -> Iterator[Block]:
    """Every body in a module: its own, those of its classes, functions, loops and branches."""
    for node in ast.walk(tree):
        for field in ("body", "orelse", "finalbody"):
            body = getattr(node, field, None)
            if not isinstance(body, list):
                continue  # of a lambda or a conditional expression
            left_out = (_is_text, _is_list_of_names, _is_sentence)
            kept = [s for s in body if not any(is_one(s) for is_one in left_out)]
            if sum(map(_span, kept)) > LONGEST:
                yield Block(
                    where,
                    tuple(s.lineno for s in kept),
                    tuple(map(shape, kept)),
                    tuple(_span(s) - _texts(s) for s in kept),
                )


def windows(block: Block) -> Iterator[tuple[Shape, int]]:
    """The runs of statements that are too long to stand twice, and where each begins."""
    for first in range(len(block.shapes)):
        lines, run = 0, 0
        for length, each in zip(block.lengths[first:], block.shapes[first:], strict=True):
            lines, run = lines + length, hash((run, each))
            if lines > LONGEST:
                yield run, block.lines[first]


def repeated(found: list[Block]) -> list[list[str]]:
    """Places, as FILE:LINE, at which passages of more than LONGEST lines have one shape."""
    places: dict[Shape, set[str]] = defaultdict(set)
    for block in found:
        for run, line in windows(block):
            places[run].add(f"{block.where}:{line}")
    return sorted(map(list, {tuple(sorted(each)) for each in places.values() if len(each) > 1}))


def test_no_passage_of_the_core_stands_twice() -> None:
    found = [
        block for source in sources("nlsid_core") for block in blocks(str(source), source.tree)
    ]
    assert len(found) > 100
    assert not repeated(found)


PASSAGE = "\n".join(f"    total += scale * values[{k}]" for k in range(LONGEST + 1))
OTHER = PASSAGE.replace("total", "mass").replace("scale", "g").replace("values", "w")


def _copies(first: str, second: str) -> list[list[str]]:
    text = f"def one(values):\n{first}\n\ndef two(w):\n    '''Two.'''\n{second}\n"
    return repeated(list(blocks("module.py", ast.parse(text))))


def test_a_copy_under_other_names_is_found() -> None:
    assert ["module.py:2", "module.py:21"] in _copies(PASSAGE, OTHER)


def test_what_is_short_or_differs_is_not() -> None:
    fewer = [text.rsplit("\n", 2)[0] for text in (PASSAGE, OTHER)]  # 15 lines with the `def`
    assert not _copies(*fewer)
    assert not _copies(PASSAGE, OTHER.replace("g * w[7]", "g / w[7]"))
