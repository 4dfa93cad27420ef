# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Quality of service by name. All can be overridden by ``qos_overrides`` parameters."""

from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy
from rclpy.qos_overriding_options import QoSOverridingOptions, QoSPolicyKind

# Inputs are best effort unless all their publishers are reliable, see AdaptiveSubscription.
# Of images the newest is the one that counts.
IMAGE = QoSProfile(history=HistoryPolicy.KEEP_LAST, depth=1,
                   reliability=ReliabilityPolicy.BEST_EFFORT,
                   durability=DurabilityPolicy.VOLATILE)
# Small messages that must not be lost to a burst: they are paired with images by stamp.
CAMERA_INFO = QoSProfile(history=HistoryPolicy.KEEP_LAST, depth=10,
                         reliability=ReliabilityPolicy.BEST_EFFORT)
DETECTIONS_IN = CAMERA_INFO
# A burst of the fastest usual IMU while something else is called back.
IMU = QoSProfile(history=HistoryPolicy.KEEP_LAST, depth=100,
                 reliability=ReliabilityPolicy.BEST_EFFORT)
# The same of the fastest usual odometry.
ODOM = QoSProfile(history=HistoryPolicy.KEEP_LAST, depth=100,
                  reliability=ReliabilityPolicy.BEST_EFFORT)
DETECTIONS_OUT = QoSProfile(history=HistoryPolicy.KEEP_LAST, depth=10,
                            reliability=ReliabilityPolicy.RELIABLE)
POSE = QoSProfile(history=HistoryPolicy.KEEP_LAST, depth=10,
                  reliability=ReliabilityPolicy.RELIABLE)
# What late listeners are to get, too.
LATCHED = QoSProfile(history=HistoryPolicy.KEEP_LAST, depth=1,
                     reliability=ReliabilityPolicy.RELIABLE,
                     durability=DurabilityPolicy.TRANSIENT_LOCAL)
# Requests are answered one after another; so many may wait.
SERVICE = QoSProfile(history=HistoryPolicy.KEEP_LAST, depth=100,
                     reliability=ReliabilityPolicy.RELIABLE)


_OVERRIDABLE = (QoSPolicyKind.HISTORY, QoSPolicyKind.DEPTH, QoSPolicyKind.RELIABILITY,
                QoSPolicyKind.DURABILITY)


def overridable(*but: QoSPolicyKind) -> QoSOverridingOptions:
    """Return the options that let a user override all policies but some."""
    return QoSOverridingOptions(
        policy_kinds=[kind for kind in _OVERRIDABLE if kind not in but])
