# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Recorded input: TUM and RGB-D folders, rosbag2 files, query and observation files."""
