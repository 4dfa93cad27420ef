# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Mapping: from posed detections to landmarks and a report. No ROS, no torch.

``building`` builds a map, or fits a given one. ``check`` judges a map, and ``update``
updates it with a new recording. ``make_map`` adds labels, embeddings, keyframes and files.

Throughout, ``shown`` (n,) is the row of the landmark that each of n boxes shows, -1 for none.
"""
