# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Factors between units."""

NS_PER_S = 1_000_000_000
