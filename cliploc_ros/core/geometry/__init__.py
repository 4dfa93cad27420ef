# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Transforms, the camera, ellipses and ellipsoids, and the minimal pose solvers."""
