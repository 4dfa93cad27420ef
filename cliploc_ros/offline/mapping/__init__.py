# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Mapping: from posed detections to landmarks and a report. No ROS, no torch, no files.

``building`` builds a map and ``refit`` fits a given one. ``check`` judges a map, and ``update``
updates it with a new recording.

Throughout, ``shown`` (n,) is the row of the landmark that each of n boxes shows, -1 for none.
"""
