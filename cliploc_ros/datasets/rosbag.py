# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Read and write rosbag2 recordings: the public names of the bag modules."""

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
