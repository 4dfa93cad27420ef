# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""From a recording to an observation file: detector and CLIP run once over it."""
