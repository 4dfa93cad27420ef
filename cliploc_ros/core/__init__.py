# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The method: from an observation and a map to a pose. No ROS, no torch.

Imports point downwards only, in this order (test/test_layout.py checks it):

localizer, relocalizer, detector_check
    Successive frames of a moving camera; localization of given frames.
watch
    Evidence that a localizer's pose is right, added up look by look.
acceptance
    Confidence, and the decision to accept or refuse.
fit
    Verification, refinement, several frames, covariance, and covariances of successive answers.
keyframes
    Poses from local features that match images taken during mapping.
search
    Correspondence candidates, minimal samples, and the best hypotheses of one frame.
observation, options
    Inputs: the frame, and the caller's options.
map
    One map or several, and their files; indices of landmarks by class, label and place.
geometry
    Transforms, camera, ellipses, ellipsoids, depth, minimal solvers.
kernels
    Functions compiled to machine code.
calibration
    The numbers that decide about poses, read from calibration.yaml.
"""
