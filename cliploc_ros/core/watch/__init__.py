# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Whether a localizer's pose is right, look by look.

The modules in the order in which a look passes them:

image_faults
    Whether the image shows anything.
alignment
    The pose near the given one that fits the detections best.
expectation
    The landmarks that the image should show there.
evidence
    Both as log odds that the given pose is right.
belief
    The probability over looks, which odometry and the time between them correlate.
missing
    The landmarks that are no longer there.
camera_turn
    How the camera is turned against its stated mount.
watch
    All of it, and the state with its reason.
"""
