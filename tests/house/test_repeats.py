"""No long passage of the core stands twice, under other names and with other numbers either."""

import ast
from collections import defaultdict
from collections.abc import Iterator, Sequence

from tests.house.sources import sources

LINES = 15  # of a passage that may stand twice


def shape(statements: Sequence[ast.stmt]) -> str:
    """The statements with their own names numbered in the order in which they come, and no numbers
    and texts.

    What the passage only reads, such as functions and types, keeps its name.
    """
    nodes = [node for statement in statements for node in ast.walk(statement)]
    own = {n.id for n in nodes if isinstance(n, ast.Name) and isinstance(n.ctx, ast.Store)}
    own |= {node.arg for node in nodes if isinstance(node, ast.arg)}
    own |= {n.name for n in nodes if isinstance(n, ast.FunctionDef | ast.ClassDef)}
    order: dict[str, str] = {}

    def dump(node: object) -> str:
        if isinstance(node, list):
            return f"[{','.join(map(dump, node))}]"
        if isinstance(node, ast.Constant):
            return "constant"
        if not isinstance(node, ast.AST):
            text = repr(node)
            return order.setdefault(text, str(len(order))) if node in own else text
        inner = ",".join(dump(value) for key, value in ast.iter_fields(node) if key != "ctx")
        return f"{type(node).__name__}({inner})"

    return dump(list(statements))


def does_something(statement: ast.stmt) -> bool:
    """Whether it is no import, no text and no list of names."""
    names = isinstance(statement, ast.Assign) and isinstance(statement.value, ast.List)
    text = isinstance(statement, ast.Expr) and isinstance(statement.value, ast.Constant)
    return not (names or text or isinstance(statement, ast.Import | ast.ImportFrom))


def passages(tree: ast.AST) -> Iterator[tuple[int, int, str]]:
    """First line, last line and shape of every least run of statements of more than LINES lines."""
    for node in ast.walk(tree):
        for block in (getattr(node, name, None) for name in ("body", "orelse", "finalbody")):
            if not isinstance(block, list):
                continue
            code = [statement for statement in block if does_something(statement)]
            for i, first in enumerate(code):
                for j in range(i, len(code)):
                    end = code[j].end_lineno or 0
                    if end - first.lineno >= LINES:
                        yield first.lineno, end, shape(code[i : j + 1])
                        break


def test_no_passage_of_more_than_fifteen_lines_stands_twice_in_the_core() -> None:
    where = defaultdict[str, list[str]](list)
    for source in sources("nlsid_core"):
        for first, last, text in passages(source.tree):
            where[text].append(f"{source}:{first}-{last}")
    assert [places for places in where.values() if len(places) > 1] == []


def test_a_passage_under_other_names_and_numbers_is_found() -> None:
    lines = [f"{{0}}_{i} = scale({{0}}_{max(i - 1, 1)}, {i}.{{1}})" for i in range(1, LINES + 2)]
    one, other = ("\n".join(lines).format(name, end) for name, end in (("a", 5), ("b", 7)))
    [(_, _, text)] = passages(ast.parse(one))
    assert [text] == [found for *_, found in passages(ast.parse(other))]
    assert text != next(passages(ast.parse(other.replace("scale(b_3", "turn(b_3"))))[2]
