# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The only place that knows ROS messages: conversions, parameters, qos, pairing, worker."""
