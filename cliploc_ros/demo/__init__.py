# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The demo: a synthetic world, models trained on it, and the whole system run in it."""
