# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""A subscription that is as reliable as its publishers."""

import threading
from collections.abc import Callable
from typing import Any

from rclpy.callback_groups import MutuallyExclusiveCallbackGroup
from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.node import Node
from rclpy.qos import QoSProfile, ReliabilityPolicy
from rclpy.qos_overriding_options import QoSPolicyKind
from rclpy.subscription import Subscription

from cliploc_ros.ros.qos import overridable


class AdaptiveSubscription:
    """Subscribes reliably while all publishers of the topic are reliable, else best effort.

    A best-effort subscription matches every camera, but loses large images even on one machine. A
    reliable one does not match a best-effort camera. The choice is made again when publishers
    come or go.

    Parameters
    ----------
    node : Node
        Made with automatically_declare_parameters_from_overrides=True.
    message_type : type
    topic : str
    callback : callable
        Takes each message, one at a time except during such a change.
    profile : QoSProfile
        All policies except the reliability.
    """

    def __init__(self, node: Node, message_type: type, topic: str,
                 callback: Callable[[Any], None], profile: QoSProfile) -> None:
        self._node = node
        self._message_type = message_type
        self._topic = node.resolve_topic_name(topic)
        self._callback = callback
        self._profile = profile
        # A reliability set by the user stays. The parameter is not declared otherwise: a declared
        # one would stay, too.
        self._overridden = node.has_parameter(
            f'qos_overrides.{self._topic}.subscription.reliability')
        # Publishers come in one thread, destroy is called in another.
        self._lock = threading.RLock()
        self._subscription: Subscription | None = None
        with self._lock:
            self._reliability = self._offered()
            self._subscription = self._create()

    def destroy(self) -> None:
        """Stop listening."""
        with self._lock:
            if self._subscription is not None:
                self._node.destroy_subscription(self._subscription)
                self._subscription = None

    def _offered(self) -> ReliabilityPolicy:
        """Return the most reliable policy that matches all present publishers."""
        offered = [info.qos_profile.reliability
                   for info in self._node.get_publishers_info_by_topic(self._topic)]
        reliable = bool(offered) and all(r == ReliabilityPolicy.RELIABLE for r in offered)
        return ReliabilityPolicy.RELIABLE if reliable else ReliabilityPolicy.BEST_EFFORT

    def _create(self) -> Subscription:
        # A group of its own: if a subscription is destroyed before its event is taken, rclpy
        # leaves the group busy for ever. Besides, a group keeps a reference to each of its former
        # members.
        group = MutuallyExclusiveCallbackGroup()
        profile = QoSProfile(history=self._profile.history, depth=self._profile.depth,
                             durability=self._profile.durability, reliability=self._reliability)
        return self._node.create_subscription(
            self._message_type, self._topic, self._callback, profile, callback_group=group,
            qos_overriding_options=overridable(
                *(() if self._overridden else (QoSPolicyKind.RELIABILITY,))),
            event_callbacks=SubscriptionEventCallbacks(
                matched=self._adapt, incompatible_qos=self._adapt))

    def _adapt(self, _: Any) -> None:
        """Subscribe again if the present publishers need another reliability."""
        with self._lock:
            offered = self._offered()
            if self._overridden or self._subscription is None or offered == self._reliability:
                return
            former, self._reliability = self._subscription, offered
            self._subscription = self._create()
            self._node.destroy_subscription(former)
