# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What detector, CLIP and sensors of a robot would say; for check_map, studio and studies.

detector
    Boxes of a view, with the misses and errors that a recording shows.
labels
    Similarities of crops and labels.
sensors
    Verticals and odometry of recorded frames, true or with errors.
"""
