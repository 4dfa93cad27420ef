# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The method: from an observation and a map to a pose. No ROS, no torch.

Imports point downwards only, in this order (test/test_layout.py checks it):

relocalizer, session, relocalization, warm_up
    Entry points and results.
acceptance
    Confidence, and the decision to accept or refuse.
fit
    Verification, refinement, several frames, covariance.
search
    Minimal samples to the best hypotheses of one frame.
keyframes
    Poses from local features of the place as it was mapped.
association
    Observation and map to candidates and the scene of one frame.
maps, observation, options
    Inputs: one map or several with their files, the frame, and what the caller chooses.
index
    Landmarks by class, by similarity of labels, and by place.
geometry
    Transforms, camera, ellipses, ellipsoids, minimal solvers.
kernels, time_budget
    Helpers: functions compiled to machine code, and the time that is left.
"""
