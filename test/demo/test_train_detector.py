# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Train the demo's detector: its file loads like any YOLO."""

import re

import numpy as np
import pytest

from cliploc_ros.models.onnx_detector import load_detector
from cliploc_ros.models.protocols import DetectorOptions
from demo.world import train_detector
from demo.world.appearance import CLASSES

pytestmark = pytest.mark.full


def test_the_command_writes_a_detector(worlds, tmp_path, capsys):
    file = tmp_path / 'yolo.pt'
    assert train_detector.run([str(worlds), '--out', str(file), '--epochs', '1', '--imgsz', '160',
                               '--batch', '2']) == 0
    assert re.search(r'1 worlds held out: mAP50 0\.\d+', capsys.readouterr().out)
    assert file.stat().st_size < 3e6
    assert str(tmp_path).encode() not in file.read_bytes()
    detector = load_detector(DetectorOptions(model=str(file), conf=0.0, max_det=5))
    assert detector.class_names == CLASSES
    found = detector.detect(np.full((480, 640, 3), 128, dtype=np.uint8))
    assert found.bboxes_xyxy.shape[1] == 4
