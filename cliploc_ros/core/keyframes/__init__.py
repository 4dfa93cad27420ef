# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Keyframes next to the landmarks: local features of the place as it looked when mapped."""
