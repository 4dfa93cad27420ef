# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Simulated worlds: geometry without pictures, to fit and to judge acceptance on many places."""
