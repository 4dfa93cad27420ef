# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The two ROS 2 nodes: declare, subscribe, convert, call, publish."""
