# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Studies of the method: programs that measure it, each one command. Not installed."""
