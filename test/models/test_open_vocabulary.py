# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The vocabulary of YOLO-World and YOLOE, with random weights: none are to be had here."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import open_clip
import pytest
import torch
from open_weights import TextTower, write_open_yolo, write_tower
from scene import make_room
from torchvision.ops import box_iou

from cliploc_ros.models.open_vocabulary import (
    prompts_of_map,
    prompts_of_names,
)
from cliploc_ros.models.protocols import DetectorOptions
from cliploc_ros.models.yolo_detector import YoloDetector
from cliploc_ros.models.yolo_weights import load_yolo
from cliploc_ros.offline.datasets.frames import Frames
from cliploc_ros.offline.recording.recorder import EVERY_FRAME, RecordingOptions, describe

pytestmark = pytest.mark.full

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
    """Return boxes and classes as ultralytics' own methods find them with these embeddings."""
    model, rows = load_yolo(file), embedded(texts)
    if 'yoloe' in file.name:
        with torch.no_grad():
            model.set_classes(texts, model.model.model[-1].get_tpe(rows))
    else:
        model.model.get_text_pe = lambda *_, **__: rows  # its tower is a package of its own
        model.set_classes(texts)
    found = model.predict(np.ascontiguousarray(image_rgb[..., ::-1]), conf=0.0, iou=0.7, imgsz=320,
                          max_det=300, device='cpu', verbose=False)[0].boxes.data.numpy()
    return found[:, :4], [texts[int(one)] for one in found[:, 5]]


@pytest.mark.parametrize('model', ['world.pt', 'yoloe.pt'])
def test_it_detects_the_texts_as_ultralytics_does(folder, image_rgb, model):
    detector = YoloDetector(options_of(folder, model))
    assert detector.class_names == ('mug', 'office chair', 'potted plant')
    found = detector.detect(image_rgb)
    boxes, classes = by_ultralytics(folder / model, list(detector.class_names), image_rgb)
    # random weights give nearly equal scores, whose order rounding decides further down
    np.testing.assert_allclose(found.bboxes_xyxy[:20], boxes[:20], atol=1e-2)
    assert list(found.class_ids[:20]) == classes[:20]


def test_two_texts_of_a_class_find_an_object_once(folder, image_rgb):
    apart = YoloDetector(options_of(folder, prompts=(('mug', 'mug'), ('red', 'red'))))
    joined = YoloDetector(options_of(folder, prompts=(('mug', 'mug'), ('red', 'mug'))))
    assert joined.class_names == ('mug',)
    both, once = apart.detect(image_rgb), joined.detect(image_rgb)
    assert set(both.class_ids) == {'mug', 'red'} and set(once.class_ids) == {'mug'}
    overlaps = box_iou(*(torch.from_numpy(one.bboxes_xyxy) for one in (both, once))).numpy()
    assert (overlaps.max(axis=1) > 0.7).all(), 'each is represented'
    among = box_iou(*[torch.from_numpy(once.bboxes_xyxy)] * 2).fill_diagonal_(0.0)
    assert among.max() <= 0.7 and (np.diff(once.scores) <= 0.0).all()


def test_openvino_runs_it_with_its_vocabulary(folder, image_rgb, caplog):
    by_torch = YoloDetector(options_of(folder)).detect(image_rgb)
    detector = YoloDetector(options_of(folder, inference='openvino'))
    found = detector.detect(image_rgb)
    assert (detector.inference, found.class_ids[:20]) == ('openvino', by_torch.class_ids[:20])
    np.testing.assert_allclose(found.bboxes_xyxy[:20], by_torch.bboxes_xyxy[:20], atol=0.5)
    other = YoloDetector(options_of(folder, inference='openvino', prompts=THREE[:2]))
    assert other.class_names == ('mug', 'office chair')
    assert len(list((folder / 'cache/openvino').iterdir())) == 2


def test_the_texts_of_a_map():
    room = replace(make_room(), labels=(*['red mug'] * 4, *['white mug'] * 7, 'a'))
    prompts = prompts_of_map(room, 'map.yaml')
    assert prompts[:3] == (('a', 'a'), ('b', 'b'), ('c', 'c'))
    # of four red mugs two are of class a; 'a' is a class, and no other text
    assert prompts[3] == ('red mug', 'a') and prompts[4][0] == 'white mug' and len(prompts) == 5




def test_recordings_depend_on_the_vocabulary(folder):
    frames = Frames(folder, 1, lambda wanted: iter(()))
    described = [describe(frames, RecordingOptions(options, None, EVERY_FRAME)) for options in (
        options_of(folder), options_of(folder, prompts=THREE[:2]),
        options_of(folder, text_model=''), options_of(folder, prompts=(), text_model=''))]
    assert len(set(described)) == 4
    assert 'prompts' not in described[3], 'files of earlier releases stay valid'
