"""Where the files that ship outside the packages are, however nlsid was installed.

`config/` holds one YAML file a robot. A checkout has it beside this package; pip and colcon put it
in `share/nlsid/config` below the prefix that also holds this package, where ROS looks for it.
"""

from pathlib import Path

from nlsid_core.errors import DataError


def config_file(name: str) -> Path:
    """The shipped configuration called `name`, such as `f1tenth.yaml`.

    Raises DataError, with the places searched, when no such file was installed.
    """
    here = Path(__file__).resolve().parents[1]
    folders = [here.parent / "config"]
    folders += [prefix / "share" / "nlsid" / "config" for prefix in here.parents]
    for folder in folders:
        if (folder / name).is_file():
            return folder / name
    searched = ", ".join(str(folder) for folder in folders)
    raise DataError(f"no configuration '{name}' was installed; searched {searched}")
