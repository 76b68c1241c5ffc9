"""What participants that were killed left in Fast DDS's shared memory, and whether it still works.

A participant has a segment of its own, and ports whose numbers the next participant takes again.
Beside each lies a file that the living hold locked. A publisher may still write into the port of a
dead subscriber while the next one reads from a new file of the same name, and then hears nothing:
Fast DDS pull request 4728.
"""

import fcntl
import os
import time
from contextlib import suppress
from pathlib import Path

FOLDER = Path("/dev/shm")
OWN = "fastrtps_*"  # of this transport; what else is there has no such locks, and may be in use
FRESH = 1.0  # s: what is younger may be locked in a moment
TRANSPORTS, PROFILES = "FASTDDS_BUILTIN_TRANSPORTS", "FASTRTPS_DEFAULT_PROFILES_FILE"
RANGE = "ROS_AUTOMATIC_DISCOVERY_RANGE"
UDP = Path(__file__).with_name("udp_on_this_machine.xml")


def avoid_what_is_stale(folder: Path = FOLDER) -> None:
    """Remove what the dead left; use no shared memory in this process if that is not sure.

    For LOCALHOST rmw_fastrtps makes its own transports, whatever the environment says of them; so
    a profile takes the place of both. One that the user has set is left as it is.
    """
    if clear(folder) or PROFILES in os.environ:
        return
    os.environ.setdefault(TRANSPORTS, "UDPv4")
    if os.environ.get(RANGE) == "LOCALHOST":
        os.environ |= {RANGE: "SYSTEM_DEFAULT", PROFILES: str(UDP)}


def clear(folder: Path = FOLDER) -> bool:
    """Remove the segments of dead participants, and all ports if nobody lives.

    Return whether no port of a dead participant is left.
    """
    locks = [*folder.glob(f"{OWN}_el"), *folder.glob(f"{OWN}_sl")]
    held = {lock.name[:-3] for lock in locks if is_held(lock)}
    left = False
    for file in folder.glob(OWN):
        name = file.name.removesuffix("_el").removesuffix("_sl")
        if name in held:
            continue
        if held and "_port" in name:
            left = True
            continue
        try:
            file.unlink(missing_ok=True)
            (folder / f"sem.{name}_mutex").unlink(missing_ok=True)
        except PermissionError:  # another user's
            left |= "_port" in name
    return not left


def is_held(lock: Path) -> bool:
    """Return whether a process holds the lock, or may be about to."""
    with suppress(FileNotFoundError), lock.open() as file:
        if time.time() - os.fstat(file.fileno()).st_mtime < FRESH:
            return True
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            return True
    return False
