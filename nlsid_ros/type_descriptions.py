"""What defines the type of a topic: a standard, a given or the installed definition.

The last comes from the node's own `~/get_type_description` service (REP 2016), which answers for
every type the node subscribes to with the .msg texts the installed type was made from.
"""

import time
from collections.abc import Mapping
from typing import Any

from rclpy.node import Node
from type_description_interfaces.srv import GetTypeDescription

from bags.recordings.definitions import Definition, definitions_from, standard_definition
from nlsid_core.errors import BagError

PATIENCE = 5.0  # s for the node's own service to answer
HASHED = "RIHS01_"  # how a known hash begins; a middleware that does not tell says INVALID


class TypeDescriptions:
    """Definitions of the types a node is subscribed to; `given` ones before the installed ones."""

    def __init__(self, node: Node, given: Mapping[str, Definition]) -> None:
        name = f"{node.get_fully_qualified_name()}/get_type_description"
        self._client = node.create_client(GetTypeDescription, name)
        self._given = given
        self._asked: dict[tuple[str, str], tuple[float, Any]] = {}

    def find(self, msgtype: str, type_hash: str) -> Definition | None:
        """The definition with the hash a publisher states; None: it was sent for, ask again.

        Raises BagError if no definition is to be had, or none that has this hash.
        """
        known = self._known(msgtype)
        if known is not None and (known.type_hash == type_hash or not type_hash.startswith(HASHED)):
            return known
        since, asked = self._asked.get((msgtype, type_hash), (time.monotonic(), None))
        if asked is None and self._client.service_is_ready():
            asked = self._client.call_async(
                GetTypeDescription.Request(
                    type_name=msgtype, type_hash=type_hash, include_type_sources=True
                )
            )
        self._asked[msgtype, type_hash] = since, asked
        if asked is not None and asked.done():
            return _described(msgtype, type_hash, known, asked.result())
        if time.monotonic() - since > PATIENCE:
            raise _unknown(msgtype, type_hash, known)
        return None

    def _known(self, msgtype: str) -> Definition | None:
        if msgtype in self._given:
            return self._given[msgtype]
        try:
            return standard_definition(msgtype)
        except BagError:
            return None


def _described(
    msgtype: str, type_hash: str, known: Definition | None, answer: GetTypeDescription.Response
) -> Definition:
    """The installed type's definition under the hash it was asked for."""
    texts = {s.type_name: s.raw_file_contents for s in answer.type_sources if s.encoding == "msg"}
    if not answer.successful or msgtype not in texts:
        raise _unknown(msgtype, type_hash, known)
    return definitions_from(texts)[msgtype]._replace(type_hash=type_hash)


def _unknown(msgtype: str, type_hash: str, known: Definition | None) -> BagError:
    what = f"message type '{msgtype}' is not known"
    if known is not None:
        what = f"'{msgtype}' is published with hash {type_hash}, known is {known.type_hash}"
    return BagError(
        f"{what}; give its {msgtype.split('/')[-1]}.msg file or its package's share folder in the "
        "parameter definitions"
    )
