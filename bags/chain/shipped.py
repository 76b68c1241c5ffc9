"""Where the files that ship outside the packages are, however nlsid was installed.

`config/` holds one YAML file a robot, `launch/` one launch file a workflow. A checkout has them
beside this package; pip and colcon put them in `share/nlsid` below the prefix that also holds this
package, where ROS looks for them.
"""

from pathlib import Path

from bags.recordings.names import listed
from nlsid_core.errors import DataError


def config_file(name: str) -> Path:
    """The shipped configuration called `name`, such as `f1tenth.yaml`.

    Raises DataError, with the names that there are, when no such file was installed.
    """
    return shipped_file("config", name)


def shipped_file(folder: str, name: str) -> Path:
    """The shipped file called `name` in `folder`; raises as `config_file`."""
    here = Path(__file__).resolve().parents[1]
    places = [here.parent / folder]
    places += [prefix / "share" / "nlsid" / folder for prefix in here.parents]
    for place in places:
        if (place / name).is_file():
            return place / name
    there = sorted({file.name for place in places for file in place.glob("*")})
    raise DataError(f"no {folder} file '{name}' is installed; there are: {listed(there)}")
