# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Offline programs: mapping, checks and updates of maps, evaluation, and the studio."""
