# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Run the executables, write small TUM folders and recordings, and listen to topics."""

import json
import os
import subprocess
import sys
import threading
import time
from collections import defaultdict
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import pytest
import rclpy
from rclpy.context import Context
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.node import Node
from rosbags.interfaces import QosHistory

from cliploc_ros.offline.datasets import bag_messages
from cliploc_ros.offline.datasets.bags import RELIABLE_QOS, BagWriter

PROJECT = Path(__file__).resolve().parents[2]
TIMEOUT_S = 120.0  # only to stop hangs, on a machine under load
SIZE = (64, 48)
START_NS = 1_700_000_000_123_456_789
MS = 1_000_000
# As `ros2 bag record` writes it: discovery reports neither history nor depth.
RECORDED_QOS = RELIABLE_QOS._replace(history=QosHistory.UNKNOWN, depth=0)


def wait_until(condition: Callable[[], bool], timeout_s: float = TIMEOUT_S) -> None:
    """Wait for a condition; fail at the time limit."""
    deadline = time.monotonic() + timeout_s
    while not condition():
        if time.monotonic() > deadline:
            pytest.fail(f'still waiting after {timeout_s} s')
        time.sleep(0.005)


def command(module: str, *args: object) -> list[str]:
    return [sys.executable, '-m', f'cliploc_ros.cli.{module}', *map(str, args)]


def run(module: str, *args: object, **options) -> subprocess.CompletedProcess:
    """Run an executable until it ends."""
    return subprocess.run(command(module, *args), cwd=PROJECT, text=True, capture_output=True,
                          timeout=TIMEOUT_S, **options)


@dataclass(frozen=True)
class SmallSequence:
    """A TUM folder of random images, and its content."""

    folder: Path
    stamps: list[str]
    images_bgr: list[np.ndarray]
    detections: Path


def write_sequence(folder: Path, count: int = 4, suffix: str = 'png') -> SmallSequence:
    """Write a small TUM folder: PNG or JPEG images, ground truth for all but the first."""
    (folder / 'rgb').mkdir(parents=True)
    random = np.random.default_rng(0)
    stamps = [f'{100 + index / 10:.6f}' for index in range(count)]
    images = [random.integers(0, 256, (SIZE[1], SIZE[0], 3), dtype=np.uint8) for _ in stamps]
    for stamp, image in zip(stamps, images, strict=True):
        assert cv2.imwrite(str(folder / 'rgb' / f'{stamp}.{suffix}'), image)
    (folder / 'rgb.txt').write_text(''.join(f'{stamp} rgb/{stamp}.{suffix}\n' for stamp in stamps))
    (folder / 'groundtruth.txt').write_text(
        ''.join(f'{100.1 + index / 100:.2f} {index} 0 0 0 0 0 1\n' for index in range(200)))
    (folder / 'camera.json').write_text(json.dumps(
        {'width': SIZE[0], 'height': SIZE[1], 'fx': 50, 'fy': 51, 'cx': 32, 'cy': 24}))
    detections = folder / 'detections.json'
    box = {'class_id': 'cup', 'score': 0.75, 'bbox_xyxy': [1, 2, 30.5, 40]}
    detections.write_text(json.dumps({'image_size': SIZE, 'frames': [
        {'timestamp': stamp, 'detections': [box] * (index % 3)}
        for index, stamp in enumerate(stamps)]}))
    return SmallSequence(folder, stamps, images, detections)


def write_poses(path, offsets_ms, topics=None):
    """Write a recording of poses at offsets [ms] on topics with their QoS."""
    topics = topics or {'/pose': RECORDED_QOS}
    with BagWriter(path, 'mcap') as bag:
        for name, qos in topics.items():
            bag.add_topic(name, bag_messages.POSE, qos)
        for offset in offsets_ms:
            stamp = START_NS + round(offset * MS)
            message = bag_messages.pose_message(stamp, 'world', np.eye(4))
            for name in topics:
                bag.write(name, stamp, message)
    return path


class Listener:
    """A node in a thread that stores serialized messages of topics with their arrival times."""

    def __init__(self) -> None:
        self.received: dict[str, list[bytes]] = defaultdict(list)
        self.times: dict[str, list[float]] = defaultdict(list)
        self._context = Context()
        rclpy.init(context=self._context)
        self.node = Node(f'listener_{os.getpid()}', context=self._context)
        self._executor = SingleThreadedExecutor(context=self._context)
        self._executor.add_node(self.node)
        self._thread = threading.Thread(target=self._spin)
        self._thread.start()

    def listen(self, topic: str, message_class: type, qos=100) -> None:
        def keep(data: bytes) -> None:
            self.times[topic].append(time.monotonic())
            self.received[topic].append(data)

        self.node.create_subscription(message_class, topic, keep, qos, raw=True)
        self._executor.wake()

    def _spin(self) -> None:
        with suppress(ExternalShutdownException):
            self._executor.spin()

    def close(self) -> None:
        self._executor.shutdown()
        self._thread.join()
        self.node.destroy_node()
        rclpy.shutdown(context=self._context)
