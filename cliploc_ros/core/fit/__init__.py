# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Verification and refinement of hypotheses in one or several frames, and their covariance."""
