# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""ROS interfaces: the components of the nodes, and the player behind replay."""
