# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Quality of service by name. Parameters ``qos_overrides`` override each of them."""

from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy
from rclpy.qos_overriding_options import QoSOverridingOptions, QoSPolicyKind

# Inputs are best effort unless all their publishers are reliable, see AdaptiveSubscription.
# Only the newest image counts.
IMAGE = QoSProfile(history=HistoryPolicy.KEEP_LAST, depth=1,
                   reliability=ReliabilityPolicy.BEST_EFFORT,
                   durability=DurabilityPolicy.VOLATILE)
# Small messages, paired with images by stamp: a burst must not displace them.
CAMERA_INFO = QoSProfile(history=HistoryPolicy.KEEP_LAST, depth=10,
                         reliability=ReliabilityPolicy.BEST_EFFORT)
DETECTIONS_IN = CAMERA_INFO
# What the fastest usual IMU, or odometry, sends while another callback runs.
IMU = ODOM = QoSProfile(history=HistoryPolicy.KEEP_LAST, depth=100,
                        reliability=ReliabilityPolicy.BEST_EFFORT)
DETECTIONS_OUT = POSE = QoSProfile(history=HistoryPolicy.KEEP_LAST, depth=10,
                                   reliability=ReliabilityPolicy.RELIABLE)
# For late subscribers, too.
LATCHED = QoSProfile(history=HistoryPolicy.KEEP_LAST, depth=1,
                     reliability=ReliabilityPolicy.RELIABLE,
                     durability=DurabilityPolicy.TRANSIENT_LOCAL)
# Requests are answered one after another; this many may wait.
SERVICE = QoSProfile(history=HistoryPolicy.KEEP_LAST, depth=100,
                     reliability=ReliabilityPolicy.RELIABLE)


_OVERRIDABLE = (QoSPolicyKind.HISTORY, QoSPolicyKind.DEPTH, QoSPolicyKind.RELIABILITY,
                QoSPolicyKind.DURABILITY)


def overridable(*but: QoSPolicyKind) -> QoSOverridingOptions:
    """Return the options that let a user override all policies except some."""
    return QoSOverridingOptions(
        policy_kinds=[kind for kind in _OVERRIDABLE if kind not in but])
