# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Transforms, cameras, ellipses, ellipsoids, and minimal pose solvers."""
