# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The two ROS 2 nodes: declare, subscribe, convert, call, publish."""

import os

# Two threads of OpenBLAS wait for each other by spinning: on a robot whose cores are busy, labels
# are compared ten times as fast by one. Read when NumPy is loaded, so before any import of it.
os.environ.setdefault('OPENBLAS_NUM_THREADS', '1')
