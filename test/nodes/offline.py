# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Start both nodes and request a pose for a picture of the demo: a program for test_prepared.

    python offline.py FOLDER ARGUMENT...

FOLDER takes the logs. Both nodes get the arguments.
"""

import os
import sys
from pathlib import Path

import cv2
import rclpy
from processes import Process, wait_for
from rclpy.node import Node
from sensor_msgs.msg import CameraInfo, Image
from std_msgs.msg import Header
from std_srvs.srv import Trigger

from cliploc_ros.offline.datasets.parsing import find_camera
from demo import ASSETS

SEQUENCE = ASSETS / 'sequence'


def request(node):
    """Publish the picture until the request is answered; return the answer."""
    camera, _ = find_camera(None, SEQUENCE)
    pixels, header = cv2.imread(str(min((SEQUENCE / 'rgb').iterdir()))), Header(frame_id='camera')
    image = Image(header=header, width=camera.width, height=camera.height, encoding='bgr8',
                  step=3 * camera.width, data=pixels.tobytes())
    info = CameraInfo(header=header, width=camera.width, height=camera.height,
                      distortion_model='plumb_bob', d=list(camera.distortion),
                      k=camera.matrix.reshape(-1).tolist())
    images, infos = node.create_publisher(Image, 'image', 1), node.create_publisher(
        CameraInfo, 'camera_info', 1)
    client = node.create_client(Trigger, 'relocalizer/relocalize')
    wait_for(client.service_is_ready, 'the service')
    future = client.call_async(Trigger.Request())

    def publish():
        header.stamp = node.get_clock().now().to_msg()
        image.header = info.header = header
        images.publish(image)
        infos.publish(info)
        rclpy.spin_once(node, timeout_sec=0.2)
    wait_for(future.done, 'the answer', work=publish)
    return future.result()


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
        answer = request(Node('client'))
        print(answer.success, answer.message)
    finally:
        for node in nodes:
            node.stop()
        rclpy.try_shutdown()


if __name__ == '__main__':
    main()
