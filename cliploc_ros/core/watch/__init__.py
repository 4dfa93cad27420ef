# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The watch: evidence, look by look, that a localizer's pose is right.

look
    The pose near the given pose that fits the detections best, and the log odds that the given
    pose is right.
camera
    Faults of the images, and the rotation of the camera relative to its stated mount.
watch
    The entry point: the probability that the pose is right, filtered over correlated looks, and
    the state with its reason.

core.map.visibility finds the landmarks that an image should show, core.map.presence those that are
gone.
"""
