# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Confidence of a pose, agreement of successive looks, and the decision to accept or refuse."""
