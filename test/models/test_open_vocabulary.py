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

from cliploc_ros.datasets.frames import Frames
from cliploc_ros.errors import ModelError, OptionsError
from cliploc_ros.models.open_vocabulary import (
    MOST_TEXTS,
    prompts_of_map,
    prompts_of_names,
    set_prompts,
)
from cliploc_ros.models.protocols import DetectorOptions
from cliploc_ros.models.yolo_detector import YoloDetector
from cliploc_ros.models.yolo_weights import load_yolo
from cliploc_ros.recording.recorder import EVERY_FRAME, RecordingOptions, describe

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


def test_without_a_vocabulary_it_keeps_its_classes(folder, image_rgb):
    detector = YoloDetector(options_of(folder, prompts=(), text_model=''))
    assert len(detector.class_names) == 80
    assert set(detector.detect(image_rgb).class_ids) <= set(detector.class_names)


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


def test_embeddings_are_cached_for_each_tower_and_vocabulary(folder, tmp_path, caplog):
    options = options_of(folder, cache_dir=str(tmp_path))
    model = load_yolo(folder / 'world.pt')

    def cached():
        set_prompts(model, options)
        return model.model.txt_feats, {file.name for file in (tmp_path / 'labels').iterdir()}
    first, files = cached()
    again, same = cached()
    assert files == same and len(files) == 1 and torch.equal(first, again)
    np.testing.assert_allclose(first, embedded([text for text, _ in THREE]), atol=1e-6)
    options = replace(options, prompts=THREE[:2])
    assert len(cached()[1]) == 2
    (tmp_path / 'labels' / next(iter(files))).write_bytes(b'damaged')
    options = replace(options, prompts=THREE)
    assert torch.equal(cached()[0], first)


def test_the_text_tower_of_yolo_world_is_clip(folder, large_clip):
    """CLIP ViT-B-32 of open_clip, as a local file; here with random weights."""
    model = load_yolo(folder / 'world.pt')
    set_prompts(model, options_of(folder, text_model=str(large_clip.file)))
    rows, expected = model.model.txt_feats[0].numpy(), large_clip.labels(
        [text for text, _ in THREE])
    assert rows.shape == expected.shape == (3, 512)
    # the weights' name, openai, stands for another activation than that of the reference
    assert (rows * expected).sum(axis=1).min() > 0.9


def test_openvino_runs_it_with_its_vocabulary(folder, image_rgb, caplog):
    by_torch = YoloDetector(options_of(folder)).detect(image_rgb)
    detector = YoloDetector(options_of(folder, inference='openvino'))
    found = detector.detect(image_rgb)
    assert (detector.inference, found.class_ids[:20]) == ('openvino', by_torch.class_ids[:20])
    np.testing.assert_allclose(found.bboxes_xyxy[:20], by_torch.bboxes_xyxy[:20], atol=0.5)
    other = YoloDetector(options_of(folder, inference='openvino', prompts=THREE[:2]))
    assert other.class_names == ('mug', 'office chair')
    assert len(list((folder / 'cache/openvino').iterdir())) == 2


def test_yoloe_stays_in_pytorch(folder):
    with pytest.raises(ModelError, match='YOLOE is not converted for OpenVINO'):
        YoloDetector(options_of(folder, 'yoloe.pt', inference='openvino'))
    assert YoloDetector(options_of(folder, 'yoloe.pt', inference='auto')).inference == 'pytorch'


def test_the_texts_of_a_map():
    room = replace(make_room(), labels=(*['red mug'] * 4, *['white mug'] * 7, 'a'))
    prompts = prompts_of_map(room, 'map.yaml')
    assert prompts[:3] == (('a', 'a'), ('b', 'b'), ('c', 'c'))
    # of four red mugs two are of class a; 'a' is a class, and no other text
    assert prompts[3] == ('red mug', 'a') and prompts[4][0] == 'white mug' and len(prompts) == 5


def test_of_too_many_texts_the_classes_are_left(caplog):
    room = make_room()
    names = [f'label {row} {"x" * row}' for row in range(12)]
    assert len(prompts_of_map(replace(room, labels=tuple(names)), 'map.yaml')) == 15
    many = MOST_TEXTS // 12 + 1
    large = replace(
        room, landmark_ids=tuple(map(str, range(12 * many))), class_ids=room.class_ids * many,
        labels=tuple(map('label {}'.format, range(12 * many))),
        centers=np.tile(room.centers, (many, 1)), semi_axes=np.tile(room.semi_axes, (many, 1)),
        quats_xyzw=np.tile(room.quats_xyzw, (many, 1)))
    assert prompts_of_map(large, 'map.yaml') == (('a', 'a'), ('b', 'b'), ('c', 'c'))
    assert f'3 classes and {12 * many} other labels, more than {MOST_TEXTS}' in caplog.text
    with pytest.raises(OptionsError, match='312 classes for the detector, expected 300 at most'):
        prompts_of_map(replace(large, class_ids=large.labels), 'map.yaml')




def test_recordings_depend_on_the_vocabulary(folder):
    frames = Frames(folder, 1, lambda wanted: iter(()))
    described = [describe(frames, RecordingOptions(options, None, EVERY_FRAME)) for options in (
        options_of(folder), options_of(folder, prompts=THREE[:2]),
        options_of(folder, text_model=''), options_of(folder, prompts=(), text_model=''))]
    assert len(set(described)) == 4
    assert 'prompts' not in described[3], 'files of earlier releases stay valid'
