# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Train the demo's detector: its file loads as any YOLO does."""

import re

import numpy as np
import pytest

from cliploc_ros.demo.truth import read_frames
from cliploc_ros.models.protocols import DetectorOptions
from cliploc_ros.models.yolo_detector import YoloDetector
from demo_world import train_detector
from demo_world.appearance import CLASSES

pytestmark = pytest.mark.full


def test_labels_are_parts_of_the_image(worlds, tmp_path):
    world = worlds / 'world_000'
    train_detector.write_dataset({'train': [world]}, tmp_path)
    frame = next(read_frames(world))
    rows = np.loadtxt(tmp_path / 'labels' / 'train' / f'world_000_{frame.timestamp}.txt', ndmin=2)
    assert len(rows) == len(frame.boxes) > 0
    for row, box in zip(rows, frame.boxes, strict=True):
        assert CLASSES[int(row[0])] == box.class_id
        center, size = row[1:3] * (640, 480), row[3:] * (640, 480)
        corners = np.concatenate([center - size / 2, center + size / 2])
        np.testing.assert_allclose(corners - 0.5, box.bbox_xyxy, atol=0.01)
    image = tmp_path / 'images' / 'train' / f'world_000_{frame.timestamp}.jpg'
    assert image.read_bytes() == frame.image.read_bytes()


def test_the_command_writes_a_detector(worlds, tmp_path, capsys):
    file = tmp_path / 'yolo.pt'
    assert train_detector.run([str(worlds), '--out', str(file), '--epochs', '1', '--imgsz', '160',
                               '--batch', '2']) == 0
    assert re.search(r'1 worlds held out: mAP50 0\.\d+', capsys.readouterr().out)
    assert file.stat().st_size < 3e6
    assert str(tmp_path).encode() not in file.read_bytes()
    detector = YoloDetector(DetectorOptions(model=str(file), conf=0.0, max_det=5))
    assert detector.class_names == CLASSES
    found = detector.detect(np.full((480, 640, 3), 128, dtype=np.uint8))
    assert found.bboxes_xyxy.shape[1] == 4
