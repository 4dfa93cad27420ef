# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Real rooms: maps of a part of each recording, asked with the rest and with other rooms."""
