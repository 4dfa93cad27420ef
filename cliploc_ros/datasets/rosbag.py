# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The door to recordings of rosbag2: reading, writing, and what their messages hold."""

from cliploc_ros.datasets.bag_reader import BagMessage, BagReader, BagTopic
from cliploc_ros.datasets.bag_types import typestore
from cliploc_ros.datasets.bag_writer import LATCHED_QOS, RELIABLE_QOS, STORAGES, BagWriter

__all__ = [
    'LATCHED_QOS',
    'RELIABLE_QOS',
    'STORAGES',
    'BagMessage',
    'BagReader',
    'BagTopic',
    'BagWriter',
    'typestore',
]
