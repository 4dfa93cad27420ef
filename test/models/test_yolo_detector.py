# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""A real YOLOv8n on real images; ultralytics uses neither network, home nor pip."""

import json
import os
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest

from cliploc_ros.errors import ModelError
from cliploc_ros.models.protocols import DetectorOptions
from cliploc_ros.models.yolo_detector import YoloDetector

pytestmark = pytest.mark.full

PROJECT = Path(__file__).resolve().parents[2]


@pytest.fixture(scope='session')
def weights(shared_data) -> Path:
    return shared_data / 'weights/yolov8n_coco.pt'


@pytest.fixture(scope='session')
def detector(weights) -> YoloDetector:
    return YoloDetector(DetectorOptions(str(weights), device='cpu'))


@pytest.fixture(scope='session')
def office_rgb(shared_data) -> np.ndarray:
    first = sorted((shared_data / 'tum_fr3_office/rgb').iterdir())[0]
    return cv2.cvtColor(cv2.imread(str(first)), cv2.COLOR_BGR2RGB)


def test_what_stands_in_the_office(detector, office_rgb):
    found = detector.detect(office_rgb)
    confident = {name for name, score in zip(found.class_ids, found.scores, strict=True)
                 if score > 0.4}
    print(f'\n{len(found)} objects, confident of {sorted(confident)}')
    assert confident >= {'chair', 'bottle'}
    assert set(found.class_ids) <= set(detector.class_names) and len(detector.class_names) == 80
    assert found.bboxes_xyxy.shape == (len(found), 4) == (len(found.scores), 4)
    assert found.bboxes_xyxy.dtype == found.scores.dtype == np.float64
    assert (found.scores >= 0.1).all() and (np.diff(found.scores) <= 0).all()
    left, top, right, bottom = found.bboxes_xyxy.T
    assert ((left >= 0) & (left < right) & (right <= 640)).all()
    assert ((top >= 0) & (top < bottom) & (bottom <= 480)).all()


def test_boxes_are_pixels_of_the_image_as_it_came(detector, office_rgb):
    found = detector.detect(office_rgb)
    large = detector.detect(cv2.resize(office_rgb, (1280, 960)))
    chair, large_chair = (each.bboxes_xyxy[each.class_ids.index('chair')]
                          for each in (found, large))
    assert np.abs(2 * chair - large_chair).max() < 40


def test_options_reach_the_network(weights, office_rgb):
    few = YoloDetector(DetectorOptions(
        str(weights), conf=0.5, max_det=3, imgsz=300, device='cpu')).detect(office_rgb)
    assert 0 < len(few) <= 3 and (few.scores >= 0.5).all()


def refusal(file: Path) -> str:
    with pytest.raises(ModelError) as caught:
        YoloDetector(DetectorOptions(str(file), device='cpu'))
    message = str(caught.value)
    assert str(file) in message and '\n' not in message and message.isascii()
    return message


def test_files_that_are_no_yolo(small_clip, tmp_path):
    assert 'no detection model' in refusal(small_clip.file)
    assert 'does not exist' in refusal(tmp_path / 'gone.pt')
    assert 'is a folder' in refusal(tmp_path)
    (tmp_path / 'text.pt').write_text('text')
    assert 'holds no weights' in refusal(tmp_path / 'text.pt')


WATCHED_RUN = """
import json, os, sys
events = []
def watch(event, arguments):
    if event in ('socket.connect', 'socket.getaddrinfo', 'socket.gethostbyname', 'os.system'):
        events.append(f'{event} {arguments}')
    elif event == 'subprocess.Popen' and 'pip' in str(arguments):
        events.append(f'{event} {arguments}')
    elif event == 'socket.sendto':
        events.append(f'{event} {arguments}')
sys.addaudithook(watch)

import numpy as np
from cliploc_ros.models.yolo_detector import YoloDetector
from cliploc_ros.models.protocols import DetectorOptions
detector = YoloDetector(DetectorOptions(sys.argv[1], device='cpu', cache_dir=sys.argv[2]))
assert detector.inference == 'openvino'
for _ in range(3):
    detector.detect(np.full((480, 640, 3), 99, np.uint8))

import threading
import ultralytics
import ultralytics.utils.events as analytics
print(json.dumps({'events': events, 'analytics': analytics.events.enabled,
                  'threads': threading.active_count(),
                  'restricted': ultralytics.utils.SAFE_LOAD,
                  'omp': os.environ.get('OMP_NUM_THREADS')}))
"""


def test_ultralytics_stays_off_network_home_and_pip(weights, tmp_path):
    home, here, temporary = (tmp_path / name for name in ('home', 'here', 'temporary'))
    for folder in (home, here, temporary):
        folder.mkdir()
    # Hide pytest: ultralytics is silent under it.
    environment = {name: value for name, value in os.environ.items()
                   if not name.startswith(('PYTEST', 'YOLO', 'XDG', 'OMP', 'ULTRALYTICS'))}
    environment |= {'HOME': str(home), 'PYTHONPATH': str(PROJECT), 'TMPDIR': str(temporary),
                    'TORCHINDUCTOR_CACHE_DIR': str(tmp_path / 'torch')}
    done = subprocess.run(
        [sys.executable, '-c', WATCHED_RUN, str(weights), str(tmp_path / 'cache')], cwd=here,
        env=environment, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr
    # One line: ultralytics printed nothing.
    assert json.loads(done.stdout) == {
        'events': [], 'analytics': False, 'threads': 1, 'restricted': True, 'omp': None}
    assert [*home.rglob('*')] == [*here.rglob('*')] == []
    assert [*temporary.glob('cliploc_ros*')] == []
