# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Detectors in ONNX files give the same boxes as their weights in PyTorch; invalid files.

Published files cannot be downloaded here: D-FINE has random weights.
"""

import json
import shutil
from pathlib import Path

import cv2
import numpy as np
import onnx
import pytest
import torch
from onnx import TensorProto, helper, numpy_helper
from onnx_exports import NAMES, SIDE, an_image, export_yolo, make_d_fine, pixels

from cliploc_ros.errors import ImageError, ModelError, OptionsError
from cliploc_ros.models.hub import is_hub_name
from cliploc_ros.models.onnx_detector import OnnxDetector
from cliploc_ros.models.profiles import load_detector
from cliploc_ros.models.protocols import DetectorOptions

pytestmark = pytest.mark.full


@pytest.fixture(scope='module')
def cache(tmp_path_factory) -> Path:
    return tmp_path_factory.mktemp('cache')


@pytest.fixture
def load(cache):
    def detector(model: object, **changes: object):
        return load_detector(DetectorOptions(**{
            'model': str(model), 'device': 'cpu', 'cache_dir': str(cache)} | changes))
    return detector


@pytest.fixture(scope='session')
def images(shared_data) -> list[np.ndarray]:
    files = sorted((shared_data / 'tum_fr3_office/rgb').iterdir())[::6]
    return [cv2.cvtColor(cv2.imread(str(file)), cv2.COLOR_BGR2RGB) for file in files]


@pytest.fixture(scope='session')
def weights(shared_data) -> Path:
    return shared_data / 'weights/yolov8n_coco.pt'


@pytest.fixture(scope='session')
def plain(weights, tmp_path_factory) -> Path:
    return export_yolo(weights, tmp_path_factory.mktemp('plain'))


@pytest.fixture(scope='session')
def dynamic(weights, tmp_path_factory) -> Path:
    return export_yolo(weights, tmp_path_factory.mktemp('dynamic'), dynamic=True)


@pytest.fixture(scope='session')
def selected(weights, tmp_path_factory) -> Path:
    return export_yolo(weights, tmp_path_factory.mktemp('selected'), nms=True, conf=0.1, iou=0.7,
                       agnostic_nms=False)


@pytest.fixture(scope='session')
def d_fine(tmp_path_factory):
    """Return a folder in the hub's layout, and the network in PyTorch."""
    folder = tmp_path_factory.mktemp('d-fine')
    return folder, make_d_fine(folder)


def in_boxes(images, size):
    """Return images padded to a square with grey borders, as an export of fixed size sees them."""
    return [cv2.copyMakeBorder(image, 80, 80, 0, 0, cv2.BORDER_CONSTANT, value=(114,) * 3)
            for image in images]


def compare(first, second, images) -> tuple[float, float]:
    """Return the largest differences of boxes [px] and scores."""
    boxes, scores, count = [0.0], [0.0], 0
    for image in images:
        found, again = first.detect(image), second.detect(image)
        assert found.class_ids == again.class_ids
        boxes.append(np.abs(found.bboxes_xyxy - again.bboxes_xyxy).max(initial=0.0))
        scores.append(np.abs(found.scores - again.scores).max(initial=0.0))
        count += len(found)
    assert count > 20
    return max(boxes), max(scores)


@pytest.mark.parametrize('form', ['dynamic', 'plain', 'selected'])
def test_boxes_of_ultralytics_equal_those_of_pytorch(form, weights, images, load, request):
    exported = load(request.getfixturevalue(form))
    assert isinstance(exported, OnnxDetector) and exported.inference == 'openvino'
    assert len(exported.class_names) == 80
    squares = images if form == 'dynamic' else in_boxes(images, 640)
    px, score = compare(exported, load(weights, inference='pytorch'), squares)
    print(f'\n{form}: boxes at most {px:.4f} px apart, scores {score:.5f}')
    assert px < 0.5 and score < 0.01


def test_an_export_with_half_precision(plain, tmp_path, images, load):
    network = onnx.load(plain)
    network.graph.input[0].type.tensor_type.elem_type = TensorProto.FLOAT16
    network.graph.node.insert(0, helper.make_node('Cast', ['images'], ['images32'],
                                                  to=TensorProto.FLOAT))
    for node in list(network.graph.node)[1:]:
        node.input[:] = ['images32' if name == 'images' else name for name in node.input]
    onnx.save(network, tmp_path / 'half.onnx')
    px, score = compare(load(tmp_path / 'half.onnx'), load(plain), images)
    assert px < 1.0 and score < 0.01


@pytest.mark.needs('transformers')
def test_boxes_of_d_fine_equal_those_of_the_library(d_fine, load):
    import transformers

    folder, network = d_fine
    detector, image = load(folder, conf=0.0, iou=1.0), an_image(SIDE, SIDE)
    assert (detector.class_names, detector.device) == (NAMES, 'cpu')
    found = detector.detect(image)
    with torch.inference_mode():
        outputs = network(torch.from_numpy(pixels(image)))
    theirs = transformers.RTDetrImageProcessor().post_process_object_detection(
        outputs, threshold=0.0, target_sizes=[(SIDE, SIDE)])[0]
    assert found.class_ids == tuple(NAMES[int(number)] for number in theirs['labels'])
    px = np.abs(found.bboxes_xyxy - np.clip(theirs['boxes'].numpy(), 0, SIDE)).max()
    score = np.abs(found.scores - theirs['scores'].numpy()).max()
    print(f'\nboxes at most {px:.5f} px apart, scores {score:.6f}')
    assert px < 0.5 and score < 0.01


@pytest.mark.needs('transformers')
def test_options_choose_boxes(d_fine, load, cache):
    folder, _ = d_fine
    image = an_image()
    detector = load(folder, conf=0.0, iou=1.0)
    every = detector.detect(image)

    def configure(**changes):
        detector.configure(DetectorOptions(str(folder), **{'conf': 0.0, 'iou': 1.0} | changes))
        return detector.detect(image)

    assert configure(conf=float(every.scores[4])).class_ids == every.class_ids[:4]
    assert configure(max_det=3).class_ids == every.class_ids[:3]
    few = configure(iou=0.0)  # of overlapping boxes, one of each class is left
    assert set(few.class_ids) == set(every.class_ids) and len(few) <= len(every)
    assert (configure(conf=1.0).bboxes_xyxy.shape) == (0, 4)
    for other in (an_image(1, 1), an_image(3, 700)):
        detector.detect(other)
    for other in (an_image()[..., 0], an_image()[:0], an_image().astype(float)):
        with pytest.raises(ImageError):
            detector.detect(other)


def test_a_network_with_a_class_for_nothing(tmp_path, load):
    """DETR's last logit means that a query found no object."""
    logits = np.array([[[2.0, 0.0, 0.0], [0.0, 0.0, 5.0], [0.0, 3.0, 1.0]]], np.float32)
    boxes = np.array([[[0.5, 0.5, 0.2, 0.4], [0.1] * 4, [0.25, 0.25, 0.5, 0.5]]], np.float32)
    write_network(tmp_path / 'model.onnx', {'logits': logits, 'pred_boxes': boxes})
    write_configs(tmp_path, ('mug', 'box'))
    found = load(tmp_path, conf=0.3).detect(an_image(100, 200))
    assert found.class_ids == ('box', 'mug')
    np.testing.assert_allclose(found.bboxes_xyxy, [[0, 0, 100, 50], [80, 30, 120, 70]], atol=1e-4)
    assert found.scores == pytest.approx([np.exp(3) / (1 + np.exp(3) + np.e),
                                          np.exp(2) / (np.exp(2) + 2)], abs=1e-6)


def test_the_confidence_in_any_object_of_the_first_yolov5(tmp_path, load):
    rows = np.array([[[32, 32, 20, 10, 0.9, 0.1, 0.8], [10, 10, 4, 4, 0.05, 0.9, 0.9]]],
                    np.float32)
    write_network(tmp_path / 'v5.onnx', {'output0': rows}, {'names': "['mug', 'box']"})
    found = load(tmp_path / 'v5.onnx', conf=0.2).detect(an_image(64, 64))
    assert found.class_ids == ('box',) and found.scores == pytest.approx([0.72])
    np.testing.assert_allclose(found.bboxes_xyxy, [[22, 27, 42, 37]], atol=1e-4)


def write_network(file, outputs, metadata=None, kind=TensorProto.FLOAT, shape=(1, 3, 64, 64),
                  opset=17):
    """Write a network with constant outputs for every image."""
    nodes = [helper.make_node('Cast', ['images'], ['float'], to=TensorProto.FLOAT),
             helper.make_node('ReduceMean', ['float'], ['mean'], keepdims=0),
             helper.make_node('Sub', ['mean', 'mean'], ['nothing'])]
    constants, results = [], []
    for name, value in outputs.items():
        constants.append(numpy_helper.from_array(value, f'{name}_value'))
        nodes.append(helper.make_node('Add', [f'{name}_value', 'nothing'], [name]))
        results.append(helper.make_tensor_value_info(name, TensorProto.FLOAT, value.shape))
    images = helper.make_tensor_value_info('images', kind, shape)
    graph = helper.make_graph(nodes, 'test', [images], results, constants)
    network = helper.make_model(graph, opset_imports=[helper.make_opsetid('', opset)],
                                ir_version=9)
    helper.set_model_props(network, metadata or {})
    onnx.save(network, file)
    return file


def write_configs(folder, names, **changes):
    (folder / 'config.json').write_text(json.dumps({'id2label': dict(enumerate(names))}))
    (folder / 'preprocessor_config.json').write_text(json.dumps(
        {'size': {'height': 64, 'width': 64}, 'do_normalize': False} | changes))


DETR = {'logits': np.zeros((1, 3, 2), np.float32), 'pred_boxes': np.zeros((1, 3, 4), np.float32)}
YOLO = {'output0': np.zeros((1, 6, 84), np.float32)}
TWO = {'names': "{0: 'mug', 1: 'box'}", 'task': 'detect', 'stride': '32'}


def refusal(load, model) -> str:
    with pytest.raises(ModelError) as caught:
        load(model)
    text = str(caught.value)
    assert '\n' not in text and len(text) < 700, text
    return text


@pytest.mark.parametrize(('outputs', 'metadata', 'changes', 'message'), [
    ({'logits': np.zeros((1, 1000), np.float32)}, TWO, {}, 'is not a detector: its outputs are'),
    (YOLO, {**TWO, 'task': 'classify'}, {}, "for the task 'classify'"),
    (YOLO, {}, {}, 'config.json is missing; .* has no class names'),
    (YOLO, {'names': 'what('}, {}, 'class names in its metadata cannot be read'),
    (YOLO, {'names': "{0: 'mug', 2: 'box'}"}, {}, 'with the keys 0, 1'),
    ({'output0': np.zeros((1, 9, 84), np.float32)}, TWO, {}, r'of 2 classes: .*\(9, 84\)'),
    (YOLO, TWO, {'kind': TensorProto.UINT8}, 'not floating-point numbers'),
    (YOLO, TWO, {'shape': (4, 3, 64, 64)}, 'takes no single colour image'),
    (YOLO, TWO, {'shape': (1, 1, 64, 64)}, 'takes no single colour image'),
    (DETR, {}, {}, 'config.json is missing')])
def test_files_that_are_no_detector(load, tmp_path, outputs, metadata, changes, message):
    file = write_network(tmp_path / 'model.onnx', outputs, metadata, **changes)
    with pytest.raises(ModelError, match=message):
        load(file)


def test_configurations_that_do_not_fit(load, tmp_path):
    write_network(tmp_path / 'model.onnx', DETR)
    write_configs(tmp_path, ('mug',) * 4)
    assert 'has 2 classes, but config.json has 4' in refusal(load, tmp_path)
    write_configs(tmp_path, ('mug', 'box'), size={'height': 32, 'width': 32})
    assert 'not from the same network' in refusal(load, tmp_path)
    write_configs(tmp_path, ('mug', 'box'), size=64)
    assert "'size' has neither" in refusal(load, tmp_path)
    write_configs(tmp_path, ('mug', 'box'), do_normalize=True)
    assert "'image_mean'" in refusal(load, tmp_path)
    (tmp_path / 'preprocessor_config.json').unlink()
    assert 'preprocessor_config.json is missing' in refusal(load, tmp_path)
    (tmp_path / 'preprocessor_config.json').write_text('[1')
    assert 'cannot be read' in refusal(load, tmp_path)


def test_damaged_files(load, plain, tmp_path):
    content = plain.read_bytes()
    (tmp_path / 'cut.onnx').write_bytes(content[:len(content) // 2])
    assert 'truncated or corrupt' in refusal(load, tmp_path / 'cut.onnx')
    (tmp_path / 'text.onnx').write_text('hello')
    assert 'holds no weights' in refusal(load, tmp_path / 'text.onnx')
    (tmp_path / 'empty.onnx').touch()
    assert 'is empty' in refusal(load, tmp_path / 'empty.onnx')
    assert 'does not exist' in refusal(load, tmp_path / 'gone.onnx')
    network = onnx.load(plain)
    onnx.save(network, tmp_path / 'apart.onnx', save_as_external_data=True,
              location='apart.onnx_data')
    load(tmp_path / 'apart.onnx')
    (tmp_path / 'apart.onnx_data').unlink()
    assert 'apart.onnx_data' in refusal(load, tmp_path / 'apart.onnx')
    network = onnx.load(plain)
    network.graph.node[0].op_type = 'Strange'
    onnx.save(network, tmp_path / 'strange.onnx')
    assert 'update OpenVINO' in refusal(load, tmp_path / 'strange.onnx')


def test_a_damaged_compiled_network_is_compiled_again(plain, images, tmp_path, caplog):
    def boxes():
        return load_detector(DetectorOptions(str(plain), device='cpu', cache_dir=str(tmp_path))
                             ).detect(images[0]).bboxes_xyxy

    before = boxes()
    blob, = tmp_path.rglob('*.blob')
    moved = Path(shutil.copytree(tmp_path, tmp_path.with_name('moved')))
    content = bytearray(blob.read_bytes())
    content[len(content) // 2:len(content) // 2 + 3000] = bytes(3000)
    blob.write_bytes(content)
    assert np.array_equal(boxes(), before)
    warning, = (record for record in caplog.records if record.levelname == 'WARNING')
    assert 'is damaged' in warning.getMessage() and str(blob.parent) in warning.getMessage()
    caplog.clear()
    assert np.array_equal(boxes(), before) and not caplog.records
    # on a robot, file and cache are in other places
    copied = shutil.copy(plain, moved / plain.name)
    load_detector(DetectorOptions(str(copied), device='cpu', cache_dir=str(moved)))
    assert len(list(moved.rglob('*.blob'))) == 1


def test_other_requests_are_refused(load, plain):
    with pytest.raises(OptionsError, match='has fixed classes'):
        load(plain, prompts=(('cup', 'cup'),))
    with pytest.raises(OptionsError, match='runs in OpenVINO'):
        load(plain, inference='pytorch')


@pytest.mark.parametrize(('model', 'expected'), [
    ('someone/d-fine.s-coco', True), ('someone/d-fine@v1.0', True), ('yolov8n.pt', False),
    ('someone/d-fine@main:onnx/model_fp16.onnx', True), ('weights/mine.pt', False),
    ('/weights/mine', False), ('some/where/mine', False), ('../mine', False), ('', False)])
def test_names_of_the_hub(model, expected):
    assert is_hub_name(model) == expected
