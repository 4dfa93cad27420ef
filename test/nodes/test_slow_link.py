# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Camera and relocalizer on two machines with a simulated slow link that loses packets."""

import json
import os
import re
import subprocess
import sys
import time

import cv2
import numpy as np
import pytest
import rclpy
from processes import PROJECT, wait_for
from rclpy.qos import QoSProfile, ReliabilityPolicy
from scene import MAP_FROM_CAMERA, make_room, see_room
from sensor_msgs.msg import CompressedImage
from tester import Tester, make_frame

pytestmark = pytest.mark.full

REQUESTS = 4
POSSIBLE = os.geteuid() == 0 and os.access('/dev/net/tun', os.W_OK)


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


@pytest.mark.needs('ip')
@pytest.mark.skipif(not POSSIBLE, reason='network namespaces with taps need root and /dev/net/tun')
def test_every_request_over_a_slow_link_is_answered(room_map):
    here = PROJECT / 'test/nodes'
    parameters = [argument for name, value in (
        ('map_file', room_map), ('matching', 'class'), ('algorithm', 'bf'), ('timeout_s', 20.0),
        ('image_transport', 'compressed')) for argument in ('-p', f'{name}:={value}')]
    done = subprocess.run(
        [sys.executable, here / 'slow_link.py', sys.executable, __file__,
         str(REQUESTS), '--', sys.executable, '-m', 'cliploc_ros.nodes.relocalizer', '--ros-args',
         *parameters],
        capture_output=True, text=True, timeout=150, cwd=PROJECT, env=os.environ | {
            'PYTHONPATH': os.pathsep.join([str(PROJECT), str(here.parent), str(here),
                                           os.environ.get('PYTHONPATH', '')]),
            'FASTRTPS_DEFAULT_PROFILES_FILE': str(PROJECT / 'config/fastdds_slow_network.xml'),
            'RMW_FASTRTPS_USE_QOS_FROM_XML': '1'})
    assert done.returncode == 0, done.stderr
    answers = [json.loads(line.removeprefix('ANSWER ')) for line in done.stdout.splitlines()
               if line.startswith('ANSWER ')]
    lost = int(re.search(r'(\d+) packets of the camera lost', done.stdout)[1])
    print(f'\n50 ms, 5 % loss, 10 Mbit/s: answers after '
          f'{[answer["seconds"] for answer in answers]} s; {lost} packets lost')
    assert lost > 0
    for answer, x in zip(answers, 0.3 + 0.05 * np.arange(REQUESTS), strict=True):
        # a request without an image fails; no answer has a wrong pose
        assert answer['message'].startswith((f'accepted: x {x:.2f} y -0.20 z -0.50 m in map, ',
                                             'no new frame'))
        assert answer['seconds'] < 21.0
    assert sum(answer['success'] for answer in answers) >= REQUESTS - 1


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
