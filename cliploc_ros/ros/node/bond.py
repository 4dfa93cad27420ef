# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The bond with which Nav2's lifecycle manager notices a node that has died."""

from typing import Any

from rclpy.node import Node

# Nav2's defaults (nav2_util::LifecycleNode and its parameter bond_heartbeat_period).
_HEARTBEAT_PERIOD_S = 0.1
_HEARTBEAT_TIMEOUT_S = 4.0


def start_bond(node: Node) -> Any:
    """Return a started bond, which the manager takes up; None where bondpy is not installed.

    Parameters
    ----------
    node : Node
        The manager identifies the bond by the node's name.
    """
    try:
        from bondpy.bondpy import Bond
    except ImportError:
        return None
    bond = Bond(node, 'bond', node.get_name())
    bond.set_heartbeat_period(_HEARTBEAT_PERIOD_S)
    bond.set_heartbeat_timeout(_HEARTBEAT_TIMEOUT_S)
    bond.start()
    return bond


def end_bond(node: Node, bond: Any) -> None:
    """Tell the manager that the node ends its work.

    bondpy destroys its publisher and subscription, but leaves them to the node: its executor
    would come upon them for ever, and do nothing else.
    """
    bond.shutdown()
    node.destroy_publisher(bond.pub)
    node.destroy_subscription(bond.sub)
