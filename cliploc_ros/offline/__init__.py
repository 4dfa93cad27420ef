# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Programs that no robot runs: mapping, checks and updates of maps, evaluation, the studio."""
