# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""YOLO on real images, open vocabularies with random weights, and profiles."""

import json
import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import open_clip
import pytest
import torch
from open_weights import TextTower, write_open_yolo, write_tower
from scene import make_room
from torchvision.ops import box_iou

from cliploc_ros.errors import ModelError
from cliploc_ros.models.clip_weights import ClipOptions
from cliploc_ros.models.hub import is_hub_name
from cliploc_ros.models.open_vocabulary import (
    prompts_of_map,
    prompts_of_names,
)
from cliploc_ros.models.profiles import (
    PROFILES,
    load_detector,
    resolve_profile,
    with_detector,
    with_encoder,
)
from cliploc_ros.models.protocols import DetectorOptions, ObjectDetector
from cliploc_ros.models.yolo_weights import import_ultralytics, load_yolo
from cliploc_ros.offline.datasets.frames import Frames
from cliploc_ros.offline.recording.recorder import EVERY_FRAME, RecordingOptions, describe

pytestmark = pytest.mark.full

PROJECT = Path(__file__).resolve().parents[2]


@pytest.fixture(scope='session')
def weights(shared_data) -> Path:
    return shared_data / 'weights/yolov8n_coco.pt'


@pytest.fixture(scope='session')
def detector(weights) -> ObjectDetector:
    return load_detector(DetectorOptions(str(weights), device='cpu'))


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
    few = load_detector(DetectorOptions(
        str(weights), conf=0.5, max_det=3, imgsz=300, device='cpu')).detect(office_rgb)
    assert 0 < len(few) <= 3 and (few.scores >= 0.5).all()


def refusal(file: Path) -> str:
    with pytest.raises(ModelError) as caught:
        load_detector(DetectorOptions(str(file), device='cpu'))
    message = str(caught.value)
    assert str(file) in message and '\n' not in message and message.isascii()
    return message


def test_files_that_are_no_yolo(small_clip, tmp_path):
    assert 'not a detection model' in refusal(small_clip.file)
    assert 'does not exist' in refusal(tmp_path / 'gone.pt')
    assert 'has none of model.onnx' in refusal(tmp_path)
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
from cliploc_ros.models.profiles import load_detector
from cliploc_ros.models.protocols import DetectorOptions
detector = load_detector(DetectorOptions(sys.argv[1], device='cpu', cache_dir=sys.argv[2]))
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
    # Hide pytest, since ultralytics is silent under it.
    environment = {name: value for name, value in os.environ.items()
                   if not name.startswith(('PYTEST', 'YOLO', 'XDG', 'OMP', 'ULTRALYTICS'))}
    environment |= {'HOME': str(home), 'PYTHONPATH': str(PROJECT), 'TMPDIR': str(temporary),
                    'TORCHINDUCTOR_CACHE_DIR': str(tmp_path / 'torch')}
    done = subprocess.run(
        [sys.executable, '-c', WATCHED_RUN, str(weights), str(tmp_path / 'cache')], cwd=here,
        env=environment, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr
    # One line, so ultralytics printed nothing.
    assert json.loads(done.stdout) == {
        'events': [], 'analytics': False, 'threads': 1, 'restricted': True, 'omp': None}
    assert [*home.rglob('*')] == [*here.rglob('*')] == []
    assert [*temporary.glob('cliploc_ros*')] == []


THREE = prompts_of_names('mug, office chair, potted plant')


@pytest.fixture(scope='session')
def folder(tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp('open_vocabulary')
    write_open_yolo(path / 'world.pt', 'yolov8n-worldv2.yaml')
    write_open_yolo(path / 'yoloe.pt', 'yoloe-v8n-seg.yaml', 'segment')
    write_tower(path / 'tower.ts')
    return path


@pytest.fixture(scope='session')
def image_rgb():
    return np.random.default_rng(0).integers(0, 255, (240, 320, 3), dtype=np.uint8)


def options_of(folder, model='world.pt', prompts=THREE, **changes) -> DetectorOptions:
    return DetectorOptions(**{
        'model': str(folder / model), 'conf': 0.0, 'imgsz': 320, 'device': 'cpu',
        'cache_dir': str(folder / 'cache'), 'inference': 'pytorch', 'prompts': prompts,
        'text_model': str(folder / 'tower.ts'), **changes})


def embedded(texts) -> torch.Tensor:
    with torch.no_grad():
        rows = TextTower(512)(open_clip.get_tokenizer('ViT-B-32')(texts))
    return torch.nn.functional.normalize(rows, dim=-1)[None]


def by_ultralytics(file, texts, image_rgb):
    """Return boxes and classes from ultralytics' methods with these embeddings."""
    model, rows = load_yolo(file), embedded(texts)
    if 'yoloe' in file.name:
        with torch.no_grad():
            model.set_classes(texts, model.model.model[-1].get_tpe(rows))
    else:
        model.model.get_text_pe = lambda *_, **__: rows  # its text tower is a separate package
        model.set_classes(texts)
    found = model.predict(np.ascontiguousarray(image_rgb[..., ::-1]), conf=0.0, iou=0.7, imgsz=320,
                          max_det=300, device='cpu', verbose=False)[0].boxes.data.numpy()
    return found[:, :4], [texts[int(result)] for result in found[:, 5]]


@pytest.mark.parametrize('model', ['world.pt', 'yoloe.pt'])
def test_it_detects_the_texts_as_ultralytics_does(folder, image_rgb, model):
    detector = load_detector(options_of(folder, model))
    assert detector.class_names == ('mug', 'office chair', 'potted plant')
    found = detector.detect(image_rgb)
    boxes, classes = by_ultralytics(folder / model, list(detector.class_names), image_rgb)
    # random weights give nearly equal scores, so rounding decides the order of the others
    np.testing.assert_allclose(found.bboxes_xyxy[:20], boxes[:20], atol=1e-2)
    assert list(found.class_ids[:20]) == classes[:20]


def test_two_texts_of_a_class_find_an_object_once(folder, image_rgb):
    apart = load_detector(options_of(folder, prompts=(('mug', 'mug'), ('red', 'red'))))
    joined = load_detector(options_of(folder, prompts=(('mug', 'mug'), ('red', 'mug'))))
    assert joined.class_names == ('mug',)
    both, once = apart.detect(image_rgb), joined.detect(image_rgb)
    assert set(both.class_ids) == {'mug', 'red'} and set(once.class_ids) == {'mug'}
    overlaps = box_iou(*(torch.from_numpy(one.bboxes_xyxy) for one in (both, once))).numpy()
    assert (overlaps.max(axis=1) > 0.7).all(), 'each is represented'
    among = box_iou(*[torch.from_numpy(once.bboxes_xyxy)] * 2).fill_diagonal_(0.0)
    assert among.max() <= 0.7 and (np.diff(once.scores) <= 0.0).all()


def test_openvino_runs_it_with_its_vocabulary(folder, image_rgb, caplog):
    by_torch = load_detector(options_of(folder)).detect(image_rgb)
    detector = load_detector(options_of(folder, inference='openvino'))
    found = detector.detect(image_rgb)
    assert (detector.inference, found.class_ids[:20]) == ('openvino', by_torch.class_ids[:20])
    np.testing.assert_allclose(found.bboxes_xyxy[:20], by_torch.bboxes_xyxy[:20], atol=0.5)
    other = load_detector(options_of(folder, inference='openvino', prompts=THREE[:2]))
    assert other.class_names == ('mug', 'office chair')
    assert len(list((folder / 'cache/onnx').iterdir())) == 2


def test_the_texts_of_a_map():
    room = replace(make_room(), labels=(*['red mug'] * 4, *['white mug'] * 7, 'a'))
    prompts = prompts_of_map(room, 'map.yaml')
    assert prompts[:3] == (('a', 'a'), ('b', 'b'), ('c', 'c'))
    # two of four red mugs are of class a; 'a' is a class, and no other text
    assert prompts[3] == ('red mug', 'a') and prompts[4][0] == 'white mug' and len(prompts) == 5


def test_recordings_depend_on_the_vocabulary(folder):
    frames = Frames(folder, 1, lambda wanted: iter(()))
    described = [describe(frames, RecordingOptions(options, None, EVERY_FRAME)) for options in (
        options_of(folder), options_of(folder, prompts=THREE[:2]),
        options_of(folder, text_model=''), options_of(folder, prompts=(), text_model=''))]
    assert len(set(described)) == 4
    assert 'prompts' not in described[3], 'files of earlier releases stay valid'


UNNAMED = ClipOptions(model='', pretrained='', device='cpu')


def test_published_networks_only():
    import_ultralytics()
    from ultralytics.utils.downloads import GITHUB_ASSETS_NAMES

    for profile in PROFILES.values():
        assert profile.detector in GITHUB_ASSETS_NAMES or is_hub_name(profile.detector)
        # an entry of the model hub can be stored for a start without a network
        assert is_hub_name(profile.clip_pretrained) or open_clip.get_pretrained_cfg(
            profile.clip_model, profile.clip_pretrained)['hf_hub']


def test_a_cpu_is_balanced():
    assert resolve_profile('auto', 'cpu') is PROFILES['balanced']
    balanced = PROFILES['balanced']
    assert with_encoder(UNNAMED, 'auto').pretrained == balanced.clip_pretrained
    assert with_detector(DetectorOptions('', device='cpu'), 'auto').model == balanced.detector


@pytest.mark.parametrize(('model', 'pretrained', 'path', 'named'), [
    ('RN50', '', '', ('RN50', 'openai')),
    ('', 'weights.pt', '', ('ViT-L-14', 'weights.pt')),
    ('', '', 'weights.pt', ('ViT-L-14', 'openai')),
    ('RN50', 'cc12m', '', ('RN50', 'cc12m'))])
def test_names_override_a_profile(model, pretrained, path, named):
    encoder = with_encoder(ClipOptions(model, pretrained, path, device='cpu'), 'fast')
    assert (encoder.model, encoder.pretrained) == named
    assert encoder.checkpoint_path == path
