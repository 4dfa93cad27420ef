# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Start both nodes and request a pose for a picture of the demo: a program for test_prepared.

    python offline.py FOLDER ARGUMENT...

FOLDER takes the logs. Both nodes get the arguments.
"""

import os
import sys
import time
from pathlib import Path

import cv2
import numpy as np
import rclpy
from frames import header_of, messages_of
from processes import Process
from tester import Tester

from cliploc_ros.core.observation import Detections
from cliploc_ros.offline.datasets.parsing import find_camera
from demo import ASSETS

SEQUENCE = ASSETS / 'sequence'


def main():
    folder, arguments = Path(sys.argv[1]), sys.argv[2:]
    # separate processes, so that each node is a new interpreter without imports of another
    variables = {'ROS_AUTOMATIC_DISCOVERY_RANGE': 'LOCALHOST'}
    os.environ.update(variables)
    nodes = [Process(f'nodes.{name}', arguments, folder / f'{name}.log', **variables)
             for name in ('detector', 'relocalizer')]
    rclpy.init()
    try:
        for node in nodes:
            node.wait_for_output('ready after')
        tester = Tester()
        tester.connect()
        pixels = cv2.imread(str(min((SEQUENCE / 'rgb').iterdir())))[..., ::-1]
        nothing = Detections(np.empty((0, 4)), (), np.empty(0))  # the detector publishes boxes
        answer = tester.relocalize(messages_of(
            nothing, header_of(time.time_ns(), 'camera'), pixels, find_camera(None, SEQUENCE)[0]
        )[:2])
        print(answer.success, answer.message)
    finally:
        for node in nodes:
            node.stop()
        rclpy.try_shutdown()


if __name__ == '__main__':
    main()
