# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""ONNX networks run without PyTorch, and give the same poses."""

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from without_pytorch import hide_pytorch

from demo import ASSETS

pytestmark = pytest.mark.full

PROJECT = Path(__file__).resolve().parents[2]
WAKE_UPS = 10
#: Prints the demo's poses (4, 4), null for a refusal, and their distances to the truth [m].
POSES = """
import json, sys
import cv2, numpy as np
from cliploc_ros.core.map.landmark_map import LandmarkMap
from cliploc_ros.core.options import RelocalizerOptions
from cliploc_ros.core.relocalizer import Relocalizer
from cliploc_ros.offline.datasets.intrinsics import find_camera
from cliploc_ros.offline.datasets.tum import read_tum
from demo import ASSETS
from cliploc_ros.models.clip_weights import ClipOptions
from cliploc_ros.models.map_rows import load_encoder_for_map
from cliploc_ros.models.observer import Observer
from cliploc_ros.models.profiles import load_detector
from cliploc_ros.models.protocols import DetectorOptions

inference, cache, wake_ups = sys.argv[1], sys.argv[2], int(sys.argv[3])
landmark_map = LandmarkMap.from_file(ASSETS / 'map.yaml')
detector = load_detector(DetectorOptions(
    str(ASSETS / ('yolo.pt' if inference == 'pytorch' else 'yolo.onnx')), inference=inference,
    cache_dir=cache, device='cpu'))
clip = ([str(ASSETS / 'clip.json'), str(ASSETS / 'clip.safetensors')] if inference == 'pytorch'
        else ['', str(ASSETS / 'clip')])
observer = Observer(*load_encoder_for_map(ClipOptions(
    *clip, inference=inference, cache_dir=cache, device='cpu', precision='fp32'),
    landmark_map, [], 'text'))
relocalizer = Relocalizer(landmark_map, RelocalizerOptions(time_budget_s=60.0))
camera, _ = find_camera(None, ASSETS / 'sequence')
found = []
for file in read_tum(ASSETS / 'sequence').image_paths[::5][:wake_ups]:
    image = np.ascontiguousarray(cv2.imread(str(file))[..., ::-1])
    boxes = detector.detect(image).usable(camera.width, camera.height, 50)
    pose = relocalizer.relocalize([observer.observe(image, camera, boxes, 0)])
    found.append(np.asarray(pose.map_from_camera).tolist() if pose.accepted else None)
print(json.dumps({'poses': found, 'engines': [detector.inference, observer._encoder.inference],
                  'loaded': sorted({'torch', 'ultralytics', 'open_clip'} & set(sys.modules))}))
"""


@pytest.fixture(scope='module')
def hidden(tmp_path_factory) -> dict[str, str]:
    return hide_pytorch(tmp_path_factory.mktemp('hidden'))


@pytest.fixture
def walk(tmp_path) -> Path:
    """Work on a copy, since evaluate stores its recording beside the folder."""
    return Path(shutil.copytree(ASSETS / 'rig/front', tmp_path / 'walk'))


def run(code: list[object], environment: dict[str, str]) -> subprocess.CompletedProcess:
    return subprocess.run([sys.executable, *map(str, code)], cwd=PROJECT, env=environment,
                          capture_output=True, text=True, timeout=300, check=False)


def test_poses_equal_those_with_pytorch(hidden, tmp_path):
    found = {}
    for inference, environment in (('openvino', hidden), ('pytorch', dict(os.environ))):
        done = run(['-c', POSES, inference, tmp_path / inference, WAKE_UPS], environment)
        assert done.returncode == 0, done.stderr
        found[inference] = json.loads(done.stdout)
        assert found[inference]['engines'] == [inference] * 2
    assert found['openvino']['loaded'] == []
    first, second = (found[name]['poses'] for name in ('openvino', 'pytorch'))
    assert [pose is None for pose in first] == [pose is None for pose in second]
    off = [np.linalg.norm(np.subtract(one, other)[:3, 3]) for one, other in
           zip(first, second, strict=True) if one is not None]
    print(f'\n{len(off)} of {WAKE_UPS} poses accepted, at most {1e3 * max(off):.2f} mm apart')
    assert len(off) >= WAKE_UPS // 2 and max(off) < 0.01


def test_networks_that_are_no_onnx_are_named_with_the_remedies(hidden, walk, tmp_path):
    (tmp_path / 'yolo.pt').symlink_to(ASSETS / 'yolo.pt')
    for file in ('clip.json', 'clip.safetensors'):
        (tmp_path / file).symlink_to(ASSETS / file)
    sources = ['-m', 'cliploc_ros.cli.evaluate', '--tum', walk, '--map',
               ASSETS / 'map.yaml', '--methods', 'auto', '--out', tmp_path / 'out']
    environment = hidden | {'XDG_CACHE_HOME': str(tmp_path / 'cache')}
    for networks, named in (
            (['--model', tmp_path / 'yolo.pt', '--no-clip'], 'yolo.pt'),
            (['--model', ASSETS / 'yolo.onnx', '--clip-model', tmp_path / 'clip.json',
              '--clip-pretrained', tmp_path / 'clip.safetensors'], '--no-clip')):
        done = run([*sources, *networks], environment)
        assert done.returncode == 1 and 'Traceback' not in done.stderr
        assert 'is not installed' in done.stderr and 'export_network' in done.stderr
        assert named in done.stderr
