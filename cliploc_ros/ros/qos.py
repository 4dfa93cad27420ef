# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Quality of service by name, and a subscription that is as reliable as its publishers."""

import math
import threading
import time
from abc import ABC, abstractmethod
from collections.abc import Callable
from typing import Any

from rclpy.callback_groups import MutuallyExclusiveCallbackGroup
from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.qos_overriding_options import QoSOverridingOptions, QoSPolicyKind
from rclpy.serialization import deserialize_message
from rclpy.subscription import Subscription

# Of all profiles the history is KEEP_LAST. Inputs are best effort unless all their publishers are
# reliable, see AdaptiveSubscription.
_BEST_EFFORT, _RELIABLE = ReliabilityPolicy.BEST_EFFORT, ReliabilityPolicy.RELIABLE
# Only the newest image counts.
IMAGE = QoSProfile(depth=1, reliability=_BEST_EFFORT, durability=DurabilityPolicy.VOLATILE)
# Small messages, paired with images by stamp: a burst must not displace them.
CAMERA_INFO = DETECTIONS_IN = SCAN = QoSProfile(depth=10, reliability=_BEST_EFFORT)
# Buffers the messages of a fast IMU or odometry while another callback runs.
IMU = ODOM = QoSProfile(depth=100, reliability=_BEST_EFFORT)
DETECTIONS_OUT = POSE = QoSProfile(depth=10, reliability=_RELIABLE)
# Late subscribers get the last message.
LATCHED = QoSProfile(depth=1, reliability=_RELIABLE, durability=DurabilityPolicy.TRANSIENT_LOCAL)
# Requests are answered one after another; up to 100 may wait.
SERVICE = QoSProfile(depth=100, reliability=_RELIABLE)


_OVERRIDABLE = (QoSPolicyKind.HISTORY, QoSPolicyKind.DEPTH, QoSPolicyKind.RELIABILITY,
                QoSPolicyKind.DURABILITY)
# Least time between two new subscriptions after empty messages [s]. Some publishers send empty
# messages all the time.
_RENEWAL_PERIOD_S = 1.0
_LOG_PERIOD_S = 5.0
_TRANSPORTS = ('compressed', 'compressedDepth')


def overridable(*but: QoSPolicyKind) -> QoSOverridingOptions:
    """Return options that allow users to override all policies except `but`."""
    return QoSOverridingOptions(policy_kinds=[kind for kind in _OVERRIDABLE if kind not in but])


def resolved(node: Node, topic: str) -> str:
    """Return the full name of a topic.

    A transport follows its base topic, as in image_transport, unless it is remapped itself.
    """
    own = str(node.resolve_topic_name(topic))
    base, _, transport = topic.rpartition('/')
    if transport in _TRANSPORTS and own == node.resolve_topic_name(topic, only_expand=True):
        return f'{node.resolve_topic_name(base)}/{transport}'
    return own


def why_silent(node: Node, name: str, topic: str, message_type: type) -> str:
    """Return why nothing arrives on a topic (its full name), with the remedy."""
    offered = {info.topic_type for info in node.get_publishers_info_by_topic(topic)}
    wanted = f'{message_type.__module__.split(".")[0]}/msg/{message_type.__name__}'
    if offered and wanted not in offered:
        return (f'no {name}: {topic} has messages of type {", ".join(sorted(offered))}, expected '
                f'{wanted}: remap {name}, or set image_transport')
    if offered:
        return (f'no {name} on {topic} from its {node.count_publishers(topic)} publisher(s): '
                'check that it publishes, and that its QoS is compatible; or it is slow')
    for other in (f'{topic}/compressed', topic.removesuffix('/compressed')):
        if other != topic and node.count_publishers(other):
            return (f'no {name}: nobody publishes {topic}, but {other} is published: set '
                    f'image_transport to {"compressed" if len(other) > len(topic) else "raw"}')
    return f'no {name}: nobody publishes {topic}; remap it, or start its publisher'


class AdaptiveSubscription:
    """Subscribes reliably while all publishers of the topic are reliable, else best effort.

    A best-effort subscription matches every camera, but loses large images even on one machine. A
    reliable subscription does not match a best-effort camera. The choice is repeated when
    publishers appear or disappear.

    Messages are taken as bytes and deserialized here. A reliable subscription that joins a stream
    of images may receive a message that Fast DDS (2.14) has already freed: one join in fifty,
    measured on busy cores. If Fast DDS deserializes, it retries that message for ever and blocks
    the whole process. Taken as bytes, the message is merely empty and is delivered repeatedly,
    until a new subscription is made.

    Parameters
    ----------
    node : Node
        Made with automatically_declare_parameters_from_overrides=True.
    callback : callable
        Called with each message. Calls do not overlap, except while the subscription is replaced.
    profile : QoSProfile
        All policies except the reliability.
    """

    def __init__(self, node: Node, message_type: type, topic: str,
                 callback: Callable[[Any], None], profile: QoSProfile) -> None:
        self._node = node
        self._message_type = message_type
        self._topic = resolved(node, topic)
        self._callback = callback
        self._profile = profile
        # A reliability set by the user is kept. Otherwise the parameter is not declared, because
        # its first value would be kept, too.
        self._overridden = node.has_parameter(
            f'qos_overrides.{self._topic}.subscription.reliability')
        self._renewed_at = -math.inf
        # Events of publishers and destroy() come from different threads.
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
        """Return the most reliable policy that matches all current publishers."""
        offered = [info.qos_profile.reliability
                   for info in self._node.get_publishers_info_by_topic(self._topic)]
        reliable = bool(offered) and all(r == _RELIABLE for r in offered)
        return _RELIABLE if reliable else _BEST_EFFORT

    def _create(self) -> Subscription:
        # Each subscription has its own group: if a subscription is destroyed before its event is
        # taken, rclpy leaves the group busy for ever. A group also keeps references to all its
        # former members.
        group = MutuallyExclusiveCallbackGroup()
        profile = QoSProfile(history=self._profile.history, depth=self._profile.depth,
                             durability=self._profile.durability, reliability=self._reliability)
        return self._node.create_subscription(
            self._message_type, self._topic, self._take, profile, raw=True, callback_group=group,
            qos_overriding_options=overridable(
                *(() if self._overridden else (QoSPolicyKind.RELIABILITY,))),
            event_callbacks=SubscriptionEventCallbacks(
                matched=self._adapt, incompatible_qos=self._adapt))

    def _adapt(self, _: Any) -> None:
        """Subscribe again if the current publishers need another reliability."""
        with self._lock:
            offered = self._offered()
            if self._overridden or self._subscription is None or offered == self._reliability:
                return
            self._reliability = offered
            self._renew(self._subscription)

    def _renew(self, former: Subscription) -> None:
        self._subscription = self._create()
        self._node.destroy_subscription(former)

    def _take(self, data: bytes) -> None:
        if not data:  # subscribe again, see the class
            with self._lock:
                now = time.monotonic()
                if self._subscription is None or now - self._renewed_at < _RENEWAL_PERIOD_S:
                    return
                self._renewed_at = now
                self._renew(self._subscription)
            self._node.get_logger().warning(f'an empty message on {self._topic}: subscribed again')
            return
        try:
            message = deserialize_message(data, self._message_type)
        except RuntimeError as error:  # RMWError, which rclpy does not export
            self._node.get_logger().error(
                f'a message on {self._topic} cannot be read: {str(error).splitlines()[0]}',
                throttle_duration_sec=_LOG_PERIOD_S)
            return
        self._callback(message)


class Listener(ABC):
    """Stores messages while its subscription is open."""

    _subscription: AdaptiveSubscription | None = None

    @abstractmethod
    def forget(self) -> None:
        """Forget all messages: later ones belong to another time or run."""

    def close(self) -> None:
        """Unsubscribe, and forget all messages."""
        if self._subscription is not None:
            self._subscription.destroy()
            self._subscription = None
        self.forget()
