# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Checking a map: what it is worth for localization, and what to do about it. Pure as mapping."""
