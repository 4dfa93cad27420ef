# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Phrases that describe objects: grammars, the shipped classes, and additions of the user."""
