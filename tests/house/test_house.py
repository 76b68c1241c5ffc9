"""What every public name owes its reader, and what the project's files have to agree on."""

import ast
import pydoc
import re
import tomllib
from collections.abc import Iterator
from xml.etree import ElementTree

import nlsid
from tests.house.sources import PACKAGES, ROOT, ROS, Source, sources

Definition = ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef
CLUMSY = re.compile(r"^(Of|By) |^What of\b|\bof what\b|\bof one[.,;:]")  # of a docstring's start
WORDS, SENTENCES = 25, re.compile(r"[.!?:;·]\W|\n\n|\n- ")  # of a sentence, at most
BLOCKS = re.compile(
    r"^(```.*?^```|---.*?^---|:::.*?$|\|.*?$|#.*?$|    .*?$)", re.DOTALL | re.MULTILINE
)
FORMULAS = re.compile(r"certificate|theory|measured")  # pages where symbols are no words
SPOKEN, CODE = re.compile(r"[A-Za-z][A-Za-z'-]+"), re.compile(r"`[^`]*`")


def public_definitions(body: list[ast.stmt], prefix: str) -> Iterator[tuple[str, Definition]]:
    """Public classes and functions of a module, and the public methods of those classes."""
    for node in body:
        if isinstance(node, Definition) and not node.name.startswith("_"):
            yield f"{prefix}.{node.name}", node
            if isinstance(node, ast.ClassDef):
                yield from public_definitions(node.body, f"{prefix}.{node.name}")


def public_names(source: Source) -> list[tuple[str, Definition]]:
    return list(public_definitions(source.tree.body, source.name))


def is_overload(node: Definition) -> bool:
    """A signature for the type checker; the docstring is on the function that follows."""
    return any(isinstance(d, ast.Name) and d.id == "overload" for d in node.decorator_list)


def test_everything_public_has_a_docstring() -> None:
    silent = [source.name for source in sources(*PACKAGES) if not ast.get_docstring(source.tree)]
    silent += [
        name
        for source in sources(*PACKAGES)
        for name, node in public_names(source)
        if not ast.get_docstring(node) and not is_overload(node)
    ]
    assert not silent


def test_docstrings_begin_with_a_subject_and_nouns() -> None:
    begun = (
        (source.name, (ast.get_docstring(node) or "").partition("\n\n")[0])
        for source in sources(*PACKAGES)
        for node in ast.walk(source.tree)
        if isinstance(node, Definition)
    )
    assert not [found for found in begun if CLUMSY.search(found[1])]


def test_sentences_of_pages_are_short() -> None:
    """Of all but `verified.md`, which states theorems to those who read Coq."""
    pages = {ROOT / "README.md", *ROOT.glob("docs/*.md")} - {ROOT / "docs" / "verified.md"}
    sentences = [
        (page.name, each)
        for page in pages
        for each in SENTENCES.split(CODE.sub("X", BLOCKS.sub("\n\n", page.read_text())))
    ]
    assert len(sentences) > 2000
    assert not [
        (name, each)
        for name, each in sentences
        if len(SPOKEN.findall(each) if FORMULAS.match(name) else each.split()) > WORDS
    ]


def test_every_public_signature_says_what_it_takes() -> None:
    """Each argument has a type; `**options` would hide them, and so would `*args` of any type."""
    hidden = []
    for source in sources(*PACKAGES):
        for name, node in public_names(source):
            if isinstance(node, ast.ClassDef):
                continue
            given = node.args
            arguments = [
                *(a for a in given.posonlyargs + given.args if a.arg not in ("self", "cls")),
                *given.kwonlyargs,
                *([given.vararg] if given.vararg else []),
            ]
            anything = given.vararg and ast.unparse(given.vararg.annotation or ast.Name("Any"))
            if (
                given.kwarg
                or anything in ("Any", "object")
                or node.returns is None
                or any(argument.annotation is None for argument in arguments)
            ):
                hidden.append(name)
    assert not hidden


def test_help_shows_types_as_they_are_written() -> None:
    public = [getattr(nlsid, name) for name in nlsid.__all__]
    assert not [each for each in public if "numpy._typing" in pydoc.render_doc(each)]


def test_every_folder_of_modules_is_a_package_and_so_gets_installed() -> None:
    folders = {source.path.parent for source in sources(*PACKAGES)}
    assert not [str(folder) for folder in folders if not (folder / "__init__.py").is_file()]


def test_no_test_imports_another_test() -> None:
    assert not [
        f"{source}:{entry.line}: {entry.module}"
        for source in sources("tests")
        for entry in source.imports
        if entry.package == "tests" and any(p.startswith("test_") for p in entry.module.split("."))
    ]


def test_the_manifest_names_every_ros_package_that_is_imported() -> None:
    imported = {name for source in sources("nlsid_ros") for name in source.packages}
    manifest = ElementTree.parse(ROOT / "package.xml").getroot()
    named = {element.text for element in manifest.iter("exec_depend")}
    assert {name for name in imported if ROS.fullmatch(name)} <= named


def test_the_version_is_the_same_everywhere() -> None:
    version = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["version"]
    assert ElementTree.parse(ROOT / "package.xml").getroot().findtext("version") == version
    headings = re.findall(r"^## (\S+)", (ROOT / "CHANGELOG.md").read_text(), re.MULTILINE)
    assert version in headings[:2], "the newest release, below Unreleased if there is one"
