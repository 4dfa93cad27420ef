# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The method: from an observation and a map to a pose. No ROS, no torch.

Imports point downwards only, in this order (test/test_layout.py checks it):

localizer, succession, relocalizer, warm_up, detector_check
    Frame after frame of a moving camera; frames to a result.
watch
    Evidence that a localizer's pose is right, look by look.
acceptance
    Confidence, and the decision to accept or refuse.
fit
    Verification, refinement, several frames, covariance.
keyframes
    Poses from local features of the place as it was mapped.
search
    Observation and map to candidates, minimal samples, and the best hypotheses of one frame.
observation, options
    Inputs: the frame, and the caller's options.
map
    One map or several with their files; landmarks by class, by similarity of labels, by place.
geometry
    Transforms, camera, ellipses, ellipsoids, minimal solvers.
kernels
    Functions compiled to machine code.
calibration
    The numbers that decide, read from calibration.yaml.
"""
