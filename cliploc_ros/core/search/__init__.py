# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The search: correspondence candidates of a frame, and its best pose hypotheses."""
