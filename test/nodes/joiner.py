# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""A process that publishes images continuously, or one that joins and leaves repeatedly."""

import sys
import time

import rclpy
from rclpy.node import Node
from rclpy.qos import QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import Image

from cliploc_ros.ros import qos
from cliploc_ros.ros.qos import AdaptiveSubscription


def publish():
    """Publish VGA images, slightly faster than a camera."""
    node = Node('camera')
    publisher = node.create_publisher(
        Image, 'image', QoSProfile(depth=10, reliability=ReliabilityPolicy.RELIABLE))
    image = Image(height=480, width=640, step=1920, encoding='rgb8')
    image.data = bytes(480 * 1920)
    while True:
        publisher.publish(image)
        rclpy.spin_once(node, timeout_sec=0.02)


def join(times):
    """Subscribe, take three images, and leave. A line is printed each time."""
    node = Node('joiner')
    for _ in range(times):
        images = []
        subscription = AdaptiveSubscription(node, Image, 'image', images.append, qos.IMAGE)
        start = time.monotonic()
        while len(images) < 3:
            rclpy.spin_once(node, timeout_sec=0.1)
        subscription.destroy()
        print(f'{time.monotonic() - start:.2f} s', flush=True)


if __name__ == '__main__':
    rclpy.init()
    publish() if sys.argv[1] == 'publish' else join(int(sys.argv[2]))
