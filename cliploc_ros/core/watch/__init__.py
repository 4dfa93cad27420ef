# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The watch: evidence that a localizer's pose is right, look by look.

look
    The pose near the given one that fits the detections best, and the log odds that the given pose
    is right.
camera
    Faults of the images, and how the camera is turned against its stated mount.
watch
    The probability over looks, which odometry and the time between them correlate; all of it, and
    the state with its reason.

The landmarks that an image should show, and those that are gone, are in core.map.visibility.
"""
