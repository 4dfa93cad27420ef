# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Mapping: from posed detections to landmarks and a report. No ROS, no torch, no files.

The modules here build a map (``building``) or fit a given one (``refit``); ``check`` says how good
a map is, ``update`` brings it up to date.

Throughout, ``shown`` (n,) has the row of the landmark that each of n boxes shows, -1 for none.
"""
