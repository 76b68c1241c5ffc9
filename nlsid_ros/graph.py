"""Who else is on a topic: several publishers, nodes of one name, and who cannot be understood.

A participant that was killed stays in DDS's graph until its lease is over. Until then nobody can
tell it from one that is only silent, and it counts.
"""

from collections.abc import Sequence

from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.qos import QoSCompatibility, QoSProfile, qos_check_compatible
from rclpy.topic_endpoint_info import TopicEndpointInfo

SILENT = 2.0  # s without a message of a publisher that is there
LEASE = 20.0  # s: Fast DDS forgets a participant that was killed
NAMELESS = "_NODE_NAME_UNKNOWN_"  # DDS tells of an endpoint before it tells of its node


def several(topic: str, publishers: Sequence[TopicEndpointInfo]) -> str:
    """Say that a topic has more than one publisher, and whose they are; empty if it has not."""
    if len(publishers) < 2:
        return ""
    return (
        f"{topic} has {len(publishers)} publishers: {names(publishers)}; stop all but one (one "
        f"that was killed counts for {LEASE:g} s)"
    )


def unheard(topic: str, publishers: Sequence[TopicEndpointInfo]) -> str:
    """Say that nothing comes on a topic that has publishers; empty if it has none."""
    if not publishers:
        return ""
    return f"nothing on {topic} for {SILENT:g} s, though {names(publishers)} publishes it"


def names(endpoints: Sequence[TopicEndpointInfo]) -> str:
    """Name the nodes of endpoints."""
    return ", ".join(sorted(map(_name, endpoints)))


def _name(endpoint: TopicEndpointInfo) -> str:
    if endpoint.node_name == NAMELESS:
        return "a node that has not told its name yet"
    return f"{endpoint.node_namespace.rstrip('/')}/{endpoint.node_name}"


def namesakes(node: Node) -> str:
    """Say that other nodes have the same name as this one; empty if none has."""
    count = node.get_node_names_and_namespaces().count((node.get_name(), node.get_namespace()))
    if count < 2:
        return ""
    return f"{count} nodes are called {node.get_fully_qualified_name()}; stop all but one"


def rivals(node: Node, publisher: Publisher) -> str:
    """Say that others publish on a topic where only one should, or which cannot hear; else empty.

    A subscriber cannot hear if it asks for a quality of service that `publisher` does not offer.
    """
    topic = publisher.topic_name
    publishers = node.get_publishers_info_by_topic(topic)
    said = [several(topic, publishers)]
    # As the graph has it, like the others': `publisher` itself has 0 for a lease without end.
    own = (node.get_name(), node.get_namespace())
    offered = next(
        (p.qos_profile for p in publishers if (p.node_name, p.node_namespace) == own), None
    )
    deaf = [
        (endpoint, why)
        for endpoint in node.get_subscriptions_info_by_topic(topic)
        if offered is not None and (why := mismatch(offered, endpoint.qos_profile))
    ]
    said += [f"{topic}: {names([endpoint])} cannot hear it: {why}" for endpoint, why in deaf]
    return "; ".join(filter(None, said))


def mismatch(offered: QoSProfile, asked: QoSProfile) -> str:
    """Say why a subscription cannot match a publisher; empty if it can."""
    verdict, why = qos_check_compatible(offered, asked)
    said = str(why).removeprefix("ERROR: ").rstrip("; ")
    return said if verdict == QoSCompatibility.ERROR else ""
