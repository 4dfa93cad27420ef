# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""A node subscribes to a running camera, as the relocalizer does for each request."""

import os
import subprocess
import sys
import time

import pytest
import rclpy
from processes import PATIENCE_S, PROJECT
from rclpy.node import Node
from rclpy.qos import QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import Image

from cliploc_ros.ros import qos
from cliploc_ros.ros.qos import AdaptiveSubscription

pytestmark = pytest.mark.full

JOINERS, JOINS = 3, 40


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


def test_every_join_receives_images():
    """Fast DDS soon blocked each of these processes if it deserialized the images itself."""
    processes = []

    def run(*arguments):
        processes.append(subprocess.Popen(
            [sys.executable, *map(str, arguments)], stdout=subprocess.PIPE, text=True,
            cwd=PROJECT, env=os.environ | {
                'PYTHONPATH': f'{PROJECT}:{os.environ.get("PYTHONPATH", "")}'}))
        return processes[-1]
    try:
        for _ in range(os.cpu_count()):
            run('-c', 'while True: pass')  # busy cores: new subscriptions meet images in transit
        run(__file__, 'publish')
        joiners = [run(__file__, 'join', JOINS) for _ in range(JOINERS)]
        joined = [joiner.communicate(timeout=2 * PATIENCE_S)[0].count(' s\n')
                  for joiner in joiners]
    finally:
        for process in processes:
            process.kill()
            process.communicate()
    assert joined == [JOINS] * JOINERS


if __name__ == '__main__':
    rclpy.init()
    publish() if sys.argv[1] == 'publish' else join(int(sys.argv[2]))
