# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""D-FINE and RT-DETR of the transformers library, small, with random weights.

Their weights cannot be downloaded here: that a trained one finds objects is not tested.
"""

import sys

import numpy as np
import PIL.Image
import pytest

from cliploc_ros.errors import ImageError, ModelError, OptionsError
from cliploc_ros.models.profiles import load_detector
from cliploc_ros.models.protocols import DetectorOptions
from cliploc_ros.models.transformers_detector import TransformersDetector, is_of_transformers

pytestmark = pytest.mark.full

NAMES = ('chair', 'cup', 'dining table')
SMALL = {'encoder_hidden_dim': 32, 'encoder_ffn_dim': 32, 'd_model': 32, 'num_queries': 12,
         'decoder_ffn_dim': 32, 'decoder_attention_heads': 4, 'encoder_attention_heads': 4,
         'decoder_layers': 2, 'encoder_layers': 1, 'id2label': dict(enumerate(NAMES))}


OF_TRANSFORMERS = pytest.mark.needs('transformers')


@pytest.fixture(scope='module')
def folder(tmp_path_factory):
    """A folder as the hub has it, of a small D-FINE."""
    import torch
    import transformers

    torch.manual_seed(0)
    backbone = transformers.HGNetV2Config(
        stem_channels=[3, 8, 8], hidden_sizes=[16, 24, 32, 40], depths=[1, 1, 1, 1],
        stage_in_channels=[8, 16, 24, 32], stage_mid_channels=[8, 8, 8, 8],
        stage_out_channels=[16, 24, 32, 40], stage_num_blocks=[1, 1, 1, 1],
        stage_numb_of_layers=[1, 1, 1, 1], out_features=['stage2', 'stage3', 'stage4'])
    config = transformers.DFineConfig(
        backbone_config=backbone, encoder_in_channels=[24, 32, 40], decoder_in_channels=[32] * 3,
        **SMALL)
    path = tmp_path_factory.mktemp('hub') / 'd-fine'
    network = transformers.DFineForObjectDetection(config)
    torch.nn.init.constant_(network.model.enc_bbox_head.layers[-1].bias, 2.0)  # boxes overlap
    network.save_pretrained(path)
    transformers.RTDetrImageProcessor(size={'height': 128, 'width': 128}).save_pretrained(path)
    return path


def options(model, **changes):
    return DetectorOptions(**{'model': str(model), 'device': 'cpu', 'conf': 0.0} | changes)


def an_image(height=90, width=160):
    return np.random.default_rng(0).integers(0, 256, (height, width, 3), dtype=np.uint8)


@OF_TRANSFORMERS
def test_boxes_are_those_of_the_library(folder):
    import transformers

    image = an_image()
    detector = load_detector(options(folder, iou=1.0))
    assert isinstance(detector, TransformersDetector)
    assert (detector.class_names, detector.device, detector.inference) == (NAMES, 'cpu', 'pytorch')
    found = detector.detect(image)
    theirs = transformers.pipeline('object-detection', model=str(folder), device='cpu')(
        PIL.Image.fromarray(image), threshold=0.0)
    assert len(found) == len(theirs) == SMALL['num_queries']
    assert found.class_ids == tuple(one['label'] for one in theirs)
    np.testing.assert_allclose(found.scores, [one['score'] for one in theirs], atol=1e-6)
    boxes = np.array([list(one['box'].values()) for one in theirs])  # whole pixels
    np.testing.assert_allclose(found.bboxes_xyxy, np.clip(boxes, 0, [160, 90] * 2), atol=1.0)


@OF_TRANSFORMERS
def test_options_choose_boxes(folder):
    detector, image = load_detector(options(folder, iou=1.0)), an_image()
    every = detector.detect(image)
    detector.configure(options(folder, iou=1.0, conf=float(every.scores[4])))
    assert detector.detect(image).class_ids == every.class_ids[:4]
    detector.configure(options(folder, iou=1.0, max_det=3))
    assert detector.detect(image).class_ids == every.class_ids[:3]
    detector.configure(options(folder, iou=0.0))  # of boxes that touch, one of each class is left
    few = detector.detect(image)
    assert set(few.class_ids) == set(every.class_ids)
    assert len(few) < len(every)
    detector.configure(options(folder, conf=1.0))
    nothing = detector.detect(image)
    assert (nothing.bboxes_xyxy.shape, nothing.class_ids) == ((0, 4), ())
    for image in (an_image(1, 1), an_image(3, 700)):
        detector.detect(image)
    for image in (an_image()[..., 0], an_image()[:0], an_image().astype(float)):
        with pytest.raises(ImageError):
            detector.detect(image)


def test_other_requests_are_refused(monkeypatch):
    for changes, message in (({'prompts': (('cup', 'cup'),)}, 'its classes are fixed'),
                             ({'inference': 'openvino'}, 'runs in PyTorch only')):
        with pytest.raises(OptionsError, match=message):
            load_detector(options('someone/d-fine', **changes))
    monkeypatch.setitem(sys.modules, 'transformers', None)
    with pytest.raises(ModelError, match='not installed'):
        load_detector(options('someone/d-fine'))


@pytest.mark.parametrize(('model', 'expected'), [
    ('someone/d-fine.s-coco', True), ('yolov8n.pt', False), ('weights/mine.pt', False),
    ('/weights/mine', False), ('some/where/mine', False), ('../mine', False), ('', False)])
def test_names_of_the_hub(model, expected):
    assert is_of_transformers(model) == expected
