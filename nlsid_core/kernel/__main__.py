"""`python -I <this folder> FILE.proof.json ...`: PROVED or REJECTED for each; status 0, 1 or 2."""

import importlib.util
import sys
from pathlib import Path

if not __package__:  # run as a folder, by a Python that has no nlsid: be the package `kernel`
    _here = Path(__file__).resolve().parent
    _spec = importlib.util.spec_from_file_location(
        "kernel", _here / "__init__.py", submodule_search_locations=[str(_here)]
    )
    assert _spec is not None
    assert _spec.loader is not None
    _kernel = importlib.util.module_from_spec(_spec)
    sys.modules["kernel"] = _kernel
    _spec.loader.exec_module(_kernel)
else:
    from . import checking as _kernel


def _shown(path: str) -> str:
    """A path on one line, as the terminal can print it."""
    line = "".join(sign if sign.isprintable() else "?" for sign in path)
    return line.encode("ascii", "replace").decode() if not path.isascii() else line


def main(paths: list[str]) -> int:
    """0 if every file is proved, 1 if one is rejected, 2 if one cannot be read."""
    if not paths:
        print("usage: python -I <kernel folder> FILE.proof.json ...", file=sys.stderr)
        return 2
    status = 0
    for path in paths:
        name = _shown(path)
        try:
            print(f"{name}: {_kernel.check(path)}")
        except OSError as error:
            print(f"{name}: cannot be read: {error.strerror}")
            status = 2
        except Exception as refusal:
            print(f"{name}: REJECTED {refusal}")
            status = max(status, 1)
    return status


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
