# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What CLIP and the sensors of a robot would say; for check_map, the studio and studies.

labels
    Similarities of crops and labels.
sensors
    Verticals and odometry of recorded frames, true or with errors.

What a detector sees is in mapping.checking.detector_model, which fits it to a recording.
"""
