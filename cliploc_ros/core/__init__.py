# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The method: from an observation and a map to a pose. No ROS, no torch."""
