# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Check how well a map supports localization, and advise. No ROS, no torch, no files."""
