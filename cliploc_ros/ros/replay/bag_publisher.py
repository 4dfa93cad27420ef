# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Make publishers with the type and the QoS of recorded ones."""

from collections.abc import Collection
from importlib import import_module
from typing import Any

from rclpy.duration import Duration
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.qos import (
    DurabilityPolicy,
    HistoryPolicy,
    LivelinessPolicy,
    QoSProfile,
    ReliabilityPolicy,
)
from rosbags.interfaces import Qos, QosDurability, QosHistory, QosLiveliness, QosReliability

from cliploc_ros.datasets.bag_reader import BagTopic
from cliploc_ros.errors import DatasetError

#: Depth where the recording has none: discovery does not report a publisher's history.
DEFAULT_DEPTH = 10
#: A recorded duration of this or more is infinite. Foxy's Fast DDS wrote the least such value.
_INFINITE_S = 2**31 - 1


def create_publisher(node: Node, topic: BagTopic, name: str) -> Publisher:
    """Make a publisher with the QoS that the recorded one offered.

    Parameters
    ----------
    node : Node
        Its node.
    topic : BagTopic
        The recorded topic.
    name : str
        The name to publish it under, before ROS's own remapping.

    Returns
    -------
    Publisher

    Raises
    ------
    DatasetError
        If the type is not installed, or differs from the recorded one.
    """
    publisher: Publisher = node.create_publisher(
        message_class(topic), name, qos_profile(topic.offered_qos)
    )
    _check_definition(node, topic, publisher.topic_name)
    return publisher


def message_class(topic: BagTopic) -> Any:
    """Return the installed class of a topic's messages.

    Raises
    ------
    DatasetError
        Naming the package to install.
    """
    package, _, name = topic.msgtype.partition('/')
    namespace, _, name = name.rpartition('/')
    try:
        return getattr(import_module(f'{package}.{namespace or "msg"}'), name)
    except (ImportError, AttributeError):
        raise DatasetError(
            f'{topic.name} needs {topic.msgtype}, but the package {package} with this type is not '
            f'installed or not sourced: apt install ros-jazzy-{package.replace("_", "-")}, or '
            f'leave the topic out: --exclude {topic.name}'
        ) from None


def qos_profile(offered: Collection[Qos]) -> QoSProfile:
    """Return the profile that replays what a topic's publishers offered.

    Of several publishers' offers it takes the strongest reliability and durability, which
    match all their subscribers.

    Parameters
    ----------
    offered : collection of Qos
        As recorded; may be empty.

    Returns
    -------
    QoSProfile
        History depth 10 where none was recorded.
    """
    if not offered:
        return QoSProfile(depth=DEFAULT_DEPTH)
    first = next(iter(offered))
    best_effort = all(one.reliability == QosReliability.BEST_EFFORT for one in offered)
    profile = QoSProfile(
        history=HistoryPolicy.KEEP_LAST,
        depth=first.depth or DEFAULT_DEPTH,
        reliability=(
            ReliabilityPolicy.BEST_EFFORT if best_effort else ReliabilityPolicy.RELIABLE
        ),
        durability=(
            DurabilityPolicy.TRANSIENT_LOCAL if is_latched(offered) else DurabilityPolicy.VOLATILE
        ),
    )
    if first.history == QosHistory.KEEP_ALL:
        profile.history = HistoryPolicy.KEEP_ALL
    if first.liveliness == QosLiveliness.MANUAL_BY_TOPIC:
        profile.liveliness = LivelinessPolicy.MANUAL_BY_TOPIC
    for name in ('deadline', 'lifespan', 'liveliness_lease_duration'):
        recorded = getattr(first, name)
        if recorded.sec < _INFINITE_S and (recorded.sec or recorded.nsec):
            setattr(profile, name, Duration(seconds=recorded.sec, nanoseconds=recorded.nsec))
    return profile


def is_latched(offered: Collection[Qos]) -> bool:
    """Return whether a recorded publisher kept messages for late subscribers."""
    return any(one.durability == QosDurability.TRANSIENT_LOCAL for one in offered)


def _check_definition(node: Node, topic: BagTopic, name: str) -> None:
    """Refuse bytes that were recorded with another definition than the installed one."""
    if not topic.type_hash.startswith('RIHS01_'):
        return  # recorded before Iron, which introduced the hash
    for endpoint in node.get_publishers_info_by_topic(name):
        if endpoint.node_name == node.get_name() and str(endpoint.topic_type_hash) not in (
            topic.type_hash, 'INVALID'
        ):
            raise DatasetError(
                f'{topic.name} was recorded with another definition of {topic.msgtype} than the '
                f'installed one; leave it out: --exclude {topic.name}'
            )
