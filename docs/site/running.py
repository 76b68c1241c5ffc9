"""Runs the blocks of a page and puts what they print below them.

A page that begins with the front matter `run: true` is executed from top to bottom in an empty
folder of its own. ```sh blocks are run by bash, ```python blocks in one process that keeps its
names, a ```yaml block whose first line is `# NAME.yaml` becomes that file. A block that fails
stops the build with what it printed. A picture `![...](run/NAME.png)` is NAME.png of the folder.
Pages stay plain Markdown: they can be read without having been run.
"""

import json
import os
import re
import shutil
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

FRONT = re.compile(r"\A---\nrun: true\n---\n")
FENCE = re.compile(r"^```(\w+)\n(.*?)^```\n", re.DOTALL | re.MULTILINE)
PICTURE = re.compile(r"(!\[[^\]]*\]\()run/([\w./-]+)\)")
LIMIT = 900.0  # s for one block
LONGEST = 90  # lines of output shown
COLUMNS = 92

_WORKER = """
import json, sys, traceback
from contextlib import redirect_stderr, redirect_stdout
from io import StringIO

names = {"__name__": "__main__"}
for line in sys.stdin:
    out, failed = StringIO(), False
    with redirect_stdout(out), redirect_stderr(out):
        try:
            exec(compile(json.loads(line), "block", "exec"), names)
        except BaseException:
            traceback.print_exc()
            failed = True
    print(json.dumps([failed, out.getvalue()]), flush=True)
"""


class BlockError(Exception):
    """A block of a page that did not run."""


def run_page(text: str, folder: Path, root: Path) -> str:
    """The page with the output of every block below it.

    folder: made empty, the blocks run in it. root: the checkout, first on Python's path. Raises
    BlockError.
    """
    if folder.exists():
        shutil.rmtree(folder)
    folder.mkdir(parents=True)
    page, done = FRONT.sub("", text), []
    with _Python(folder, root) as python:
        position = 0
        for block in FENCE.finditer(page):
            done.append(page[position : block.end()])
            position = block.end()
            language, code = block[1], block[2]
            if language == "sh":
                output = _shell(code, folder, root)
            elif language == "python":
                output = python.run(code)
            else:
                _write_named(code, folder)
                continue
            done.extend(_shown(output))
        done.append(page[position:])
    return "".join(done)


def pictures(page: str, folder: Path, target: Path) -> str:
    """The page with its pictures copied from the folder that it ran in to `target`, by its name."""

    def placed(match: re.Match[str]) -> str:
        source = folder / match[2]
        if not source.is_file():
            raise BlockError(f"no block made the picture {match[2]}")
        name = f"{folder.name}-{match[2].replace('/', '-')}"
        target.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(source, target / name)
        return f"{match[1]}/{target.name}/{name})"

    return PICTURE.sub(placed, page)


def _write_named(code: str, folder: Path) -> None:
    name = re.match(r"# ([\w-]+\.(?:yaml|py))\n", code)
    if name:
        (folder / name[1]).write_text(code)


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


def _shell(code: str, folder: Path, root: Path) -> str:
    command = ["bash", "-euo", "pipefail", "-c", code]
    try:
        done = subprocess.run(
            command,
            cwd=folder,
            env=_environment(root),
            stdin=subprocess.DEVNULL,
            text=True,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            timeout=LIMIT,
            check=False,
        )
    except subprocess.TimeoutExpired as error:
        raise BlockError(f"after {LIMIT:g} s still running:\n{code}") from error
    if done.returncode:
        raise BlockError(f"status {done.returncode} from\n{code}\n{done.stdout}")
    return done.stdout


class _Python:
    """A Python process that keeps its names from block to block."""

    def __init__(self, folder: Path, root: Path) -> None:
        self._folder, self._root = folder, root
        self._process: subprocess.Popen[str] | None = None

    def __enter__(self) -> "_Python":
        return self

    def __exit__(self, *_: object) -> None:
        if self._process is not None:
            self._process.kill()
            self._process.wait()

    def run(self, code: str) -> str:
        if self._process is None:
            self._process = subprocess.Popen(
                [sys.executable, "-c", _WORKER],
                cwd=self._folder,
                env=_environment(self._root),
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                text=True,
            )
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        self._process.stdin.write(json.dumps(code) + "\n")
        self._process.stdin.flush()
        answer = self._process.stdout.readline()
        if not answer:
            raise BlockError(f"Python ended in\n{code}")
        failed, output = json.loads(answer)
        if failed:
            raise BlockError(f"{output}\nfrom\n{code}")
        return str(output)


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
