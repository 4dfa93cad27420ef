# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Maps of other systems: one module for each format, a path in, ellipsoids out."""
