"""Runs the blocks of a page as a notebook, and puts what they print below them.

A page that begins with the front matter `run: true` becomes a notebook, which is executed from top
to bottom in an empty folder of its own. ```sh blocks are cells that bash runs, ```python blocks
share their names, a ```yaml block whose first line is `# NAME.yaml` becomes that file. A block that
fails stops the build with what it printed. A picture `![...](run/NAME.png)` is NAME.png of the
folder. Pages stay plain Markdown: they can be read without having been run.
"""

import os
import re
import shutil
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import nbformat
from nbclient import NotebookClient
from nbclient.exceptions import CellExecutionError, CellTimeoutError

FRONT = re.compile(r"\A---\nrun: true\n---\n")
FENCE = re.compile(r"^```(\w+)\n(.*?)^```\n", re.DOTALL | re.MULTILINE)
PICTURE = re.compile(r"(!\[[^\]]*\]\()run/([\w./-]+)\)")
NAMED = re.compile(r"# ([\w-]+\.(?:yaml|py))\n")
LIMIT = 900  # s for one block
LONGEST = 90  # lines of output shown
COLUMNS = 92
V4: Any = nbformat.v4
SHELL = "%%script bash -euo pipefail\n"


class BlockError(Exception):
    """A block of a page that did not run."""


def notebook(page: str) -> Any:
    """The page as a notebook that has not been run: a cell for each passage and each block."""
    cells, position = [], 0
    for block in FENCE.finditer(page):
        cells.append(V4.new_markdown_cell(page[position : block.start()].strip()))
        cells.append(_cell(block[1], block[2]))
        position = block.end()
    cells.append(V4.new_markdown_cell(page[position:].strip()))
    for cell in cells:
        cell.source = PICTURE.sub(r"\1\2)", cell.source)
    return V4.new_notebook(cells=[cell for cell in cells if cell.source])


def _cell(language: str, code: str) -> Any:
    name = NAMED.match(code)
    if language == "python":
        return V4.new_code_cell(code.rstrip())
    if language == "sh":
        return V4.new_code_cell(SHELL + code)
    if name:
        return V4.new_code_cell(f"%%writefile {name[1]}\n{code}")
    return V4.new_markdown_cell(f"```{language}\n{code}```")


def run_page(text: str, folder: Path, root: Path) -> str:
    """The page with the output of every block below it; the notebook is FOLDER/FOLDER.ipynb.

    folder: made empty, the blocks run in it. root: the checkout, first on Python's path. Raises
    BlockError.
    """
    if folder.exists():
        shutil.rmtree(folder)
    folder.mkdir(parents=True)
    page = FRONT.sub("", text)
    made = notebook(page)
    client = NotebookClient(
        made, timeout=LIMIT, kernel_name="python3", resources={"metadata": {"path": str(folder)}}
    )
    try:
        client.execute(env=_environment(root))
    except (CellExecutionError, CellTimeoutError) as error:
        raise BlockError(str(error)) from error
    (folder / f"{folder.name}.ipynb").write_text(V4.writes(made))
    outputs = (cell for cell in made.cells if cell.cell_type == "code")
    done, position = [], 0
    for block in FENCE.finditer(page):
        done.append(page[position : block.end()])
        position = block.end()
        if block[1] in ("sh", "python"):
            done.extend(_shown(_printed(next(outputs))))
        elif NAMED.match(block[2]):
            next(outputs)  # says only that it wrote the file
    return "".join([*done, page[position:]])


def _printed(cell: Any) -> str:
    """What a cell wrote, its streams one after the other as they came, and its last value."""
    return "".join(
        output.get("text") or output.get("data", {}).get("text/plain", "") + "\n"
        for output in cell.outputs
    )


def pictures(page: str, folder: Path, target: Path) -> str:
    """The page with its pictures copied from the folder that it ran in to `target`, by its name.

    The notebook is copied as well, with a link below the title.
    """

    def placed(match: re.Match[str]) -> str:
        source = folder / match[2]
        if not source.is_file():
            raise BlockError(f"no block made the picture {match[2]}")
        name = f"{folder.name}-{match[2].replace('/', '-')}"
        shutil.copyfile(source, target / name)
        return f"{match[1]}/{target.name}/{name})"

    target.mkdir(parents=True, exist_ok=True)
    shutil.copy(folder / f"{folder.name}.ipynb", target)
    link = f"{{download}}`This page as a notebook </{target.name}/{folder.name}.ipynb>`"
    title, _, rest = PICTURE.sub(placed, page).lstrip().partition("\n")
    return f"{title}\n\n{link}, executed as it stands here.\n{rest}"


def _environment(root: Path) -> dict[str, str]:
    paths = [str(Path(sys.executable).parent), os.environ.get("PATH", "")]
    return os.environ | {
        "PATH": os.pathsep.join(paths),
        "PYTHONPATH": str(root),
        "COLUMNS": str(COLUMNS),
        "NO_COLOR": "1",
        "TERM": "dumb",
        "MPLBACKEND": "Agg",
    }


def _shown(output: str) -> Iterator[str]:
    """The output as a block, without the scratch folder's name and with long ones cut."""
    lines = [line.rstrip() for line in output.replace("\r", "\n").splitlines()]
    while lines and not lines[0]:
        lines.pop(0)
    while lines and not lines[-1]:
        lines.pop()
    if not lines:
        return
    if len(lines) > LONGEST:
        left = len(lines) - LONGEST
        lines = [*lines[: LONGEST - 10], f"... {left} lines ...", *lines[-10:]]
    yield "\n```{code-block} text\n:class: output\n\n" + "\n".join(lines) + "\n```\n"


def main(arguments: list[str]) -> None:
    """Run pages outside Sphinx: python -m docs.site.running PAGE... prints each with its output."""
    root = Path(__file__).resolve().parents[2]
    for page in map(Path, arguments):
        begun = time.monotonic()
        print(run_page(page.read_text(), root / "build" / "pages" / page.stem, root))
        print(f"{page}: {time.monotonic() - begun:.1f} s", file=sys.stderr)


if __name__ == "__main__":
    main(sys.argv[1:])
