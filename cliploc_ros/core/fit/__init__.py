# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Verification and refinement of hypotheses on one frame or several, and covariance."""
