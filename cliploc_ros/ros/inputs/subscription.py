# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""A subscription that is as reliable as what it listens to."""

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
    """Listens reliably while every publisher of its topic offers that, else with best effort.

    A best-effort reader matches every camera, but loses large images even on one machine; a
    reliable one never matches a best-effort camera. Publishers come and go, so the choice is
    made anew with each.

    Parameters
    ----------
    node : Node
        Made with automatically_declare_parameters_from_overrides=True.
    message_type : type
    topic : str
    callback : callable
        Takes each message, one at a time but for the moment of such a change.
    profile : QoSProfile
        All but the reliability.
    """

    def __init__(self, node: Node, message_type: type, topic: str,
                 callback: Callable[[Any], None], profile: QoSProfile) -> None:
        self._node = node
        self._message_type = message_type
        self._topic = node.resolve_topic_name(topic)
        self._callback = callback
        self._profile = profile
        # What a user sets stays; else the parameter must not be declared, or it would stay too.
        self._overridden = node.has_parameter(
            f'qos_overrides.{self._topic}.subscription.reliability')
        # Publishers come while others destroy, in another thread.
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
        """Return the most reliable policy that matches all publishers known now."""
        offered = [info.qos_profile.reliability
                   for info in self._node.get_publishers_info_by_topic(self._topic)]
        reliable = bool(offered) and all(r == ReliabilityPolicy.RELIABLE for r in offered)
        return ReliabilityPolicy.RELIABLE if reliable else ReliabilityPolicy.BEST_EFFORT

    def _create(self) -> Subscription:
        # A group of its own: where an event of a subscription that was destroyed meanwhile is to
        # be taken, rclpy takes the group for busy ever after. And a group keeps a dead reference
        # to everything that ever was in it.
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
        """Listen anew if the publishers that are there now offer something else."""
        with self._lock:
            offered = self._offered()
            if self._overridden or self._subscription is None or offered == self._reliability:
                return
            former, self._reliability = self._subscription, offered
            self._subscription = self._create()
            self._node.destroy_subscription(former)
