# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The only place that knows ROS: the parts of the nodes, and the player behind replay."""
