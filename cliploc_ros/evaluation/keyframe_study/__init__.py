# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""What ``python -m cliploc_ros.evaluation.keyframes`` is made of."""
