# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
r"""A camera that requests its pose from a relocalizer on another machine, and prints each answer.

    PYTHONPATH=.:test:test/nodes python test/nodes/remote_camera.py REQUESTS

It publishes JPEG images reliably; only the newest message is kept.
"""

import json
import sys
import time

import cv2
import numpy as np
import rclpy
from processes import wait_for
from rclpy.qos import QoSProfile, ReliabilityPolicy
from scene import MAP_FROM_CAMERA, make_room, see_room
from sensor_msgs.msg import CompressedImage
from tester import Tester, make_frame


def frames(count):
    """Yield a frame for each request, each from another place, with a photo-like image."""
    small = np.random.default_rng(0).integers(0, 256, (30, 40, 3), dtype=np.uint8)
    pixels = cv2.resize(small, (640, 480), interpolation=cv2.INTER_CUBIC)
    jpeg = cv2.imencode('.jpg', pixels, [cv2.IMWRITE_JPEG_QUALITY, 90])[1].tobytes()
    for number in range(count):
        pose = MAP_FROM_CAMERA.copy()
        pose[0, 3] += 0.05 * number
        image, info, detections = make_frame(see_room(make_room(), pose), 100.0 + number)
        yield info, detections, CompressedImage(
            header=image.header, format='rgb8; jpeg compressed bgr8', data=jpeg)


def ask(camera, frame):
    """Request a pose and publish a frame, each time with a new stamp; return the result."""
    began_at, future = time.monotonic(), camera.ask()

    def publish():
        frame[0].header.stamp.nanosec += 1_000_000  # the stamp of all three messages
        camera.publish(frame)
        for _ in range(10):
            camera.spin()
    wait_for(future.done, 'an answer', work=publish)
    answer = future.result()
    return {'seconds': round(time.monotonic() - began_at, 3), 'message': answer.message,
            'success': answer.success}


def main():
    rclpy.init()
    camera = Tester()
    profile = QoSProfile(depth=1, reliability=ReliabilityPolicy.RELIABLE)
    for name in ('compressed', 'infos', 'detections'):
        former = getattr(camera, name)
        setattr(camera, name, camera.create_publisher(former.msg_type, former.topic_name, profile))
        camera.destroy_publisher(former)
    camera.connect()
    for frame in frames(int(sys.argv[1])):
        print('ANSWER ' + json.dumps(ask(camera, frame)), flush=True)
    camera.destroy_node()
    rclpy.try_shutdown()


if __name__ == '__main__':
    main()
