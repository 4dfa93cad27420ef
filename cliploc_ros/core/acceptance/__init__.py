# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Acceptance of a pose.

The modules in the order in which a pose passes them:

contenders
    The poses that may be right, of objects and of keyframes, and the odds of each.
depth_check
    Check of the depths of a request.
confidence
    The evidence of the objects for a pose, what a region known before says, and from these odds to
    the probability of each pose, given its rivals.
comparison
    The contenders in one list: which one leads, and all evidence about it; mirror images.
look_alikes, genuine
    Other reasons to be wrong: a place that looks alike, a picture or a change.
looks
    The earlier looks of a moving robot.
camera_check
    Whether boxes, camera_info, mounts and map agree, over all looks of a localizer.
verdict
    Accept or refuse, with the reason.
"""
