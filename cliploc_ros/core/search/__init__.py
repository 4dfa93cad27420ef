# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""From the boxes of a frame to correspondence candidates, and on to its best hypotheses."""
