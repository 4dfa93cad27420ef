# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Weights for PyTorch localize the demo, also without PyTorch once they are exported."""

import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from without_pytorch import hide_pytorch

from demo import ASSETS

pytestmark = pytest.mark.full

PROJECT = Path(__file__).resolve().parents[2]
WAKE_UPS = 5
#: Prints the demo's poses (4, 4), null for a refusal.
POSES = """
import json, sys
import cv2, numpy as np
from cliploc_ros.core.map.landmark_map import LandmarkMap
from cliploc_ros.core.observation import Observation
from cliploc_ros.core.options import RelocalizerOptions
from cliploc_ros.core.relocalizer import Relocalizer
from cliploc_ros.errors import ModelError
from cliploc_ros.offline.datasets.parsing import find_camera
from cliploc_ros.offline.datasets.tum import read_tum
from demo import ASSETS
from cliploc_ros.models.protocols import ClipOptions
from cliploc_ros.models.clip_encoder import load_encoder_for_map
from cliploc_ros.models.observer import Observer
from cliploc_ros.models.onnx_detector import load_detector
from cliploc_ros.models.protocols import DetectorOptions

model, clip_model, pretrained, cache, wake_ups = sys.argv[1:]
landmark_map = LandmarkMap.from_file(ASSETS / 'map.yaml')
try:
    observer = Observer(*load_encoder_for_map(
        ClipOptions(clip_model, pretrained, cache_dir=cache), landmark_map, [], 'text'))
    detector = load_detector(DetectorOptions(model, cache_dir=cache))
except ModelError as error:
    sys.exit(f'error: {error}')
relocalizer = Relocalizer(landmark_map, RelocalizerOptions(time_budget_s=60.0))
camera, _ = find_camera(None, ASSETS / 'sequence')
found = []
for file in read_tum(ASSETS / 'sequence').image_paths[::5][:int(wake_ups)]:
    image = np.ascontiguousarray(cv2.imread(str(file))[..., ::-1])
    boxes = detector.detect(image).usable(camera.width, camera.height, 50)
    crops = observer.crops(image, boxes.bboxes_xyxy, {}).compare(np.arange(len(boxes)))
    pose = relocalizer.relocalize([Observation(camera, boxes, crops)])
    found.append(np.asarray(pose.map_from_camera).tolist() if pose.accepted else None)
print(json.dumps({'poses': found,
                  'loaded': sorted({'torch', 'ultralytics', 'open_clip'} & set(sys.modules))}))
"""
ONNX = (ASSETS / 'yolo.onnx', '', ASSETS / 'clip')
WEIGHTS = (ASSETS / 'yolo.pt', ASSETS / 'clip.json', ASSETS / 'clip.safetensors')


def localize(networks: tuple, cache: Path, environment: dict[str, str]
             ) -> subprocess.CompletedProcess:
    return subprocess.run(
        [sys.executable, '-c', POSES, *map(str, networks), str(cache), str(WAKE_UPS)],
        cwd=PROJECT, env=environment, capture_output=True, text=True, timeout=300, check=False)


@pytest.fixture
def hidden(tmp_path):
    (tmp_path / 'hidden').mkdir()
    return hide_pytorch(tmp_path / 'hidden')


@pytest.mark.parametrize(('networks', 'named'), [
    (WEIGHTS, '--no-clip'), ((WEIGHTS[0], *ONNX[1:]), 'yolo.pt')])
def test_without_pytorch_weights_are_refused_with_what_to_do(networks, named, hidden, tmp_path):
    done = localize(networks, tmp_path / 'empty', hidden)
    assert done.returncode == 1 and 'Traceback' not in done.stderr
    assert 'is not installed' in done.stderr and 'export_network' in done.stderr
    assert 'script/setup models' in done.stderr and named in done.stderr


def test_weights_are_exported_once_and_then_need_no_pytorch(hidden, tmp_path):
    cache, found = tmp_path / 'cache', []
    for networks, environment in ((ONNX, hidden), (WEIGHTS, dict(os.environ)), (WEIGHTS, hidden)):
        done = localize(networks, cache, environment)
        assert done.returncode == 0, done.stderr
        answer = json.loads(done.stdout)
        assert bool(answer['loaded']) == (environment is not hidden)
        found.append(answer['poses'])
    assert found[1] == found[2]
    assert [pose is None for pose in found[0]] == [pose is None for pose in found[1]]
    off = [np.linalg.norm(np.subtract(one, other)[:3, 3])
           for one, other in zip(*found[:2], strict=True) if one is not None]
    print(f'\n{len(off)} of {WAKE_UPS} poses accepted, at most {1e3 * max(off):.2f} mm apart')
    assert len(off) >= WAKE_UPS // 2 and max(off) < 0.01
