# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What detector, CLIP and sensors of a robot would say; for check_map, the studio and studies.

detector
    The boxes that a detector finds, with guessed or measured errors.
labels
    Similarities of crops and labels.
sensors
    Verticals and odometry of recorded frames, true or with errors.
"""
