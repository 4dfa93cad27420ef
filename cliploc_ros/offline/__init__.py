# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What no robot runs: maps from recordings, their check and update, evaluation, the studio."""
