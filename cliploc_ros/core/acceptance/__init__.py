# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Acceptance of a pose.

The modules, in the order in which they process a pose:

contenders
    The poses that may be right, found by objects or by keyframes, and the odds of each pose.
depth_check
    Check of the depths of a request.
confidence
    The evidence of the objects and of a prior region for a pose; the probability of each pose,
    given its rivals.
comparison
    All contenders in one list; the evidence about the leading pose; mirror images.
look_alikes, genuine
    Other reasons why a pose may be wrong: a place that looks alike, a picture, a changed place.
links
    Whether odometry links the frames of several instants.
looks
    The earlier looks of a moving robot.
camera_check
    Check that boxes, camera_info, mounts and map agree, over all looks of a localizer.
verdict
    The decision to accept or refuse, with the reason.
"""
