# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Replaces bondpy 4.1 of ROS 2, which is not on PyPI (the package of that name is another)."""
