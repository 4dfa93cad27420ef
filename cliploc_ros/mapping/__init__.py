# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Mapping: from posed detections to landmarks and a report. No ROS, no torch, no files."""
