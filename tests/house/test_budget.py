"""The budget: how many statements each room has, and the caps on functions and classes.

A number here is only lowered (docs/decisions/0043-a-budget-in-statements.md, which says what is
wanted). Whoever raises one names the user in a decision of their own, and what left for it.
"""

import ast
from functools import cache

import pytest

from tests.house.sources import sources

STATEMENTS = {
    ("nlsid_core",): 17_842,
    ("bags",): 11_500,
    ("nlsid_ros",): 2_601,
    ("tests",): 21_064,
    ("benchmarks", "examples"): 3_793,
}
ARGUMENTS, FIELDS = 6, 8
RECORDS = {  # their fields are the members of a file, the columns of a table, or options
    "ContinuousTracking",
    "LStep",
    "MonotoneEquation",
    "OutputTube",
    "Reading",
    "Scalar",
    "StateAffineModel",
    "StateModel",
    "Trajectory",
    "Tube",
}
EVERYTHING = ("nlsid_core", "bags", "nlsid_ros", "benchmarks", "examples", "tests")

Documented = ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef


@cache
def nodes(tree: ast.Module) -> list[ast.AST]:
    """All of it: to walk every file is what takes time here."""
    return list(ast.walk(tree))


def statements(tree: ast.Module) -> int:
    """Statements of a module at any depth; a docstring is none."""
    documented = [node for node in nodes(tree) if isinstance(node, Documented)]
    docstrings = [node for node in documented if ast.get_docstring(node, clean=False) is not None]
    return sum(isinstance(node, ast.stmt) for node in nodes(tree)) - len(docstrings)


def arguments(node: ast.FunctionDef | ast.AsyncFunctionDef) -> int:
    """Arguments of a function; those that a method is bound to are none."""
    given = node.args
    names = [each.arg for each in given.posonlyargs + given.args + given.kwonlyargs]
    return len([name for name in names if name not in ("self", "cls")])


def fields(node: ast.ClassDef) -> int:
    """Annotated names of a class."""
    return sum(isinstance(each, ast.AnnAssign) for each in node.body)


@pytest.mark.parametrize("folders", STATEMENTS, ids=" and ".join)
def test_a_room_stays_within_its_budget(folders: tuple[str, ...]) -> None:
    counted = sum(statements(source.tree) for source in sources(*folders))
    assert counted <= STATEMENTS[folders]


def test_no_function_takes_many_arguments() -> None:
    assert not [
        f"{source}:{node.lineno} {node.name} takes {arguments(node)}"
        for source in sources(*EVERYTHING)
        for node in nodes(source.tree)
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef) and arguments(node) > ARGUMENTS
    ]


def test_no_other_class_has_many_fields() -> None:
    many = {
        node.name
        for source in sources(*EVERYTHING)
        for node in nodes(source.tree)
        if isinstance(node, ast.ClassDef) and fields(node) > FIELDS
    }
    assert many == RECORDS


def test_no_line_is_kept_from_the_formatter() -> None:
    pragma = "# fmt:" + " skip"
    assert not [str(source) for source in sources(*EVERYTHING) if pragma in source.text]


def _counted(text: str) -> int:
    return statements(ast.parse(text))


def test_a_statement_is_counted_at_any_depth_and_a_docstring_is_not() -> None:
    assert _counted("'''Module.'''\nx = 1\ndef f():\n    '''Docstring.'''\n    return x\n") == 3
    assert _counted("if x:\n    a = 1; b = 2\nelse:\n    'a string of its own'\n") == 4


def _functions(text: str) -> list[ast.FunctionDef]:
    return [node for node in ast.walk(ast.parse(text)) if isinstance(node, ast.FunctionDef)]


def test_arguments_of_every_kind_are_counted() -> None:
    (function,) = _functions("def f(self, a, /, b, *rest, c, d=1): ...")
    assert arguments(function) == 4
