# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Real rooms: map a part of each recording, query it with the other part and with other rooms."""
