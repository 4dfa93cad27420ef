# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The two ROS 2 nodes: declare, subscribe, convert, call, publish."""

import os

# OpenBLAS's threads wait for each other by spinning. On busy cores, one thread compares labels ten
# times as fast as two. NumPy reads this variable when it is loaded.
os.environ.setdefault('OPENBLAS_NUM_THREADS', '1')
