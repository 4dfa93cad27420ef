# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Detectors and CLIPs in ONNX files: small ones with known outputs, invalid and damaged files."""

import hashlib
import json
import shutil
from pathlib import Path

import cv2
import numpy as np
import onnx
import pytest
from onnx import TensorProto, helper, numpy_helper
from scene import unit_rows
from scipy.special import expit
from tokenizers import Tokenizer, models, pre_tokenizers, processors

from cliploc_ros.errors import ModelError, OptionsError
from cliploc_ros.models.clip_encoder import ClipEncoder, LabelCache, encode_labels
from cliploc_ros.models.exports import describe_export
from cliploc_ros.models.files import is_hub_name
from cliploc_ros.models.onnx_clip import names_onnx, resolve_clip_weights
from cliploc_ros.models.onnx_detector import load_detector
from cliploc_ros.models.protocols import ClipOptions, DetectorOptions
from demo import ASSETS


@pytest.fixture(scope='module')
def cache(tmp_path_factory) -> Path:
    return tmp_path_factory.mktemp('cache')


@pytest.fixture
def load(cache):
    def detector(model: object, **changes: object):
        return load_detector(DetectorOptions(**{
            'model': str(model), 'cache_dir': str(cache)} | changes))
    return detector


def an_image(height=90, width=160):
    """Return an image of noise."""
    return np.random.default_rng(0).integers(0, 256, (height, width, 3), dtype=np.uint8)


@pytest.fixture
def queries(load, tmp_path):
    """Return a function that finds boxes with a network like D-FINE: 4 queries, 2 classes."""
    logits = np.array([[[0.0, -1.0], [2.0, -9.0], [1.0, -9.0], [-9.0, 1.5]]], np.float32)
    boxes = np.array([[[0.5, 0.5, 0.2, 0.4], [0.3, 0.3, 0.2, 0.2], [0.31, 0.3, 0.2, 0.2],
                       [0.9, 0.9, 0.4, 0.4]]], np.float32)
    write_network(tmp_path / 'model.onnx', {'logits': logits, 'pred_boxes': boxes})
    write_configs(tmp_path, ('mug', 'box'))
    detector = load(tmp_path)

    def find(image=None, **changes):
        detector.configure(DetectorOptions(str(tmp_path), **{'conf': 0.0, 'iou': 1.0} | changes))
        return detector.detect(an_image(100, 200) if image is None else image)
    return find


def test_the_pairs_of_a_query_and_a_class_compete(queries):
    """As in transformers: as many pairs as queries, by the sigmoid of their logits."""
    found = queries()
    assert found.class_ids == ('mug', 'box', 'mug', 'mug')
    assert found.scores == pytest.approx(expit([2.0, 1.5, 1.0, 0.0]), abs=1e-6)
    np.testing.assert_allclose(found.bboxes_xyxy, [
        [40, 20, 80, 40], [140, 70, 200, 100], [42, 20, 82, 40], [80, 30, 120, 70]], atol=1e-4)


def test_options_choose_boxes(queries):
    every = queries()
    assert queries(conf=float(every.scores[2])).class_ids == every.class_ids[:2]
    assert queries(max_det=3).class_ids == every.class_ids[:3]
    assert queries(iou=0.5).scores.tolist() == every.scores[[0, 1, 3]].tolist()
    assert queries(conf=1.0).bboxes_xyxy.shape == (0, 4)
    for image in (an_image(1, 1), an_image(3, 700)):
        queries(image)


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


def write_probe(file, kind=TensorProto.FLOAT, layout='classes'):
    """Write a YOLO whose two scores are its input at a corner (red) and in the middle (blue)."""
    rows = np.array([[32, 32, 20, 10], [32, 32, 20, 10]], np.float32)
    names = ['corner', 'middle']
    nodes = [helper.make_node('Cast', ['images'], ['float'], to=TensorProto.FLOAT)]
    constants = [numpy_helper.from_array(np.eye(2, dtype=np.float32), 'eye')]
    for name, (channel, y, x) in zip(names, ((0, 0, 0), (2, 32, 32)), strict=True):
        place = np.array([0, channel, y, x], np.int64)
        constants += [numpy_helper.from_array(place, f'{name}_from'),
                      numpy_helper.from_array(place + 1, f'{name}_to')]
        nodes.append(helper.make_node('Slice', ['float', f'{name}_from', f'{name}_to'], [name]))
    constants.append(numpy_helper.from_array(np.array([1, 2, 1], np.int64), 'column'))
    nodes += [helper.make_node('Concat', names, ['pair'], axis=1),
              helper.make_node('Reshape', ['pair', 'column'], ['scores'])]
    if layout == 'classes':  # (1, 4 + classes, boxes): each box has one class
        constants.append(numpy_helper.from_array(rows.T[None], 'boxes'))
        nodes += [helper.make_node('Mul', ['scores', 'eye'], ['each']),
                  helper.make_node('Concat', ['boxes', 'each'], ['output0'], axis=1)]
        shape = (1, 6, 2)
    else:  # (1, boxes, 6): corners, score, class
        edges = np.array([[[22, 27, 42, 37], [22, 27, 42, 37]]], np.float32)
        constants += [numpy_helper.from_array(edges, 'boxes'), numpy_helper.from_array(
            np.array([[[0], [1]]], np.float32), 'numbers')]
        nodes.append(helper.make_node('Concat', ['boxes', 'scores', 'numbers'], ['output0'],
                                      axis=2))
        shape = (1, 2, 6)
    save(file, nodes, constants, [helper.make_tensor_value_info('output0', TensorProto.FLOAT,
                                                                shape)], TWO, kind)
    return file


@pytest.mark.parametrize('kind', [TensorProto.FLOAT, TensorProto.FLOAT16])
@pytest.mark.parametrize('layout', ['classes', 'selected'])
def test_an_image_is_scaled_into_a_grey_border_and_boxes_back(tmp_path, load, kind, layout):
    """100 x 50 pixels become 64 x 32, 16 pixels below the upper border of 64 x 64."""
    detector = load(write_probe(tmp_path / 'probe.onnx', kind, layout), conf=0.1, iou=1.0)
    assert detector.class_names == ('mug', 'box')
    image = np.full((50, 100, 3), (10, 20, 200), np.uint8)  # RGB
    found = detector.detect(image)
    assert dict(zip(found.class_ids, found.scores, strict=True)) == pytest.approx(
        {'mug': 114 / 255, 'box': 200 / 255}, abs=1e-3)
    scale = 100 / 64
    np.testing.assert_allclose(found.bboxes_xyxy, [[22 * scale, 11 * scale, 42 * scale,
                                                    21 * scale]] * 2, atol=1e-3)


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
    return save(file, nodes, constants, results, metadata, kind, shape, opset)


def save(file, nodes, constants, results, metadata=None, kind=TensorProto.FLOAT,
         shape=(1, 3, 64, 64), opset=17):
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
    (YOLO, {'names': "{0: 'mug', 2: 'box'}"}, {}, 'with the keys 0, 1'),
    (YOLO, {'names': "{0: 'mug', 1: None}"}, {}, "class 1 has the name 'None'"),
    (YOLO, TWO | {'stride': '0'}, {}, "'stride' is '0'"),
    (YOLO, TWO | {'stride': '9' * 5000}, {}, "'stride' is '9"),
    ({'output0': np.zeros((1, 9, 84), np.float32)}, TWO, {}, r'of 2 classes: .*\(9, 84\)'),
    (YOLO, TWO, {'kind': TensorProto.UINT8}, 'images of integers'),
    (YOLO, TWO, {'shape': (1, 1, 64, 64)}, 'takes no single colour image'),
    (YOLO, TWO, {'shape': (1, 64, 64, 3)}, 'channels first: export it so'),
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
    (tmp_path / 'preprocessor_config.json').write_text('[1')
    assert 'cannot be read' in refusal(load, tmp_path)
    for name in (None, '', ' ', True, ['mug'], 'm' * 2000):
        write_configs(tmp_path, ('mug', name))
        assert 'config.json' in (text := refusal(load, tmp_path)) and 'class 1 has' in text


WRONG = (True, 'two', [1, 1], {}, -1, 10**19, 1e300, float('nan'))


@pytest.mark.parametrize('name', ['size', 'height', 'do_rescale', 'rescale_factor', 'resample',
                                  'do_normalize', 'image_mean', 'image_std'])
def test_each_field_of_a_preparation(load, tmp_path, name):
    """A null field counts as missing; other types and huge numbers are refused."""
    values = {'logits': np.zeros((1, 3, 2), np.float32), 'pred_boxes': DETR['pred_boxes'] + .5}
    write_network(tmp_path / 'model.onnx', values)
    for value in (None, *WRONG):
        whole = {'do_normalize': True, 'image_mean': MEAN, 'image_std': STD}
        write_configs(tmp_path, ('mug', 'box'), **whole | (
            {'size': {'height': value, 'width': 64}} if name == 'height' else {name: value}))
        is_right = ((value is None and name.startswith(('do', 're')))
                    or (value is True and name.startswith('do'))
                    or (value == -1 and name == 'image_mean'))
        if is_right:
            assert len(load(tmp_path).detect(an_image()).scores)
        else:
            text = refusal(load, tmp_path)
            assert f"'{name}'" in text or "'size'" in text, text


YOLO_FILE = ASSETS / 'yolo.onnx'


def test_damaged_files(load, tmp_path):
    content, file = YOLO_FILE.read_bytes(), tmp_path / 'file.onnx'
    for damaged in (content[:len(content) // 2], b'', b'hello'):
        file.write_bytes(damaged)
        assert 'OpenVINO cannot read' in refusal(load, file)
    assert 'No such file' in refusal(load, tmp_path / 'gone.onnx')
    network = onnx.load(YOLO_FILE)
    network.graph.node[0].op_type = 'Strange'
    onnx.save(network, tmp_path / 'strange.onnx')
    assert 'update OpenVINO' in refusal(load, tmp_path / 'strange.onnx')


@pytest.mark.parametrize('place', ['elsewhere', 'links'])
def test_each_byte_of_a_network_counts(load, tmp_path, place):
    """A damaged network that was compiled is not used in place of the sound one."""
    file = tmp_path / 'snapshot/apart.onnx'
    file.parent.mkdir()
    onnx.save(onnx.load(YOLO_FILE), file, save_as_external_data=True, location=place)
    changed = file.with_name(place)
    if place == 'links':  # as in the hub's cache
        for path in (changed, file):
            path.symlink_to(path.rename(tmp_path / f'blob of {path.name}'))
    sound = changed.read_bytes()
    half = len(sound) // 2
    image = cv2.imread(str(min((ASSETS / 'sequence/rgb').iterdir())))[..., ::-1]
    found = []
    for content in (sound[:half] + bytes(400) + sound[half + 400:], sound):
        changed.write_bytes(content)
        found.append(load(file).detect(image).bboxes_xyxy)
    expected = load(YOLO_FILE).detect(image).bboxes_xyxy
    assert not np.array_equal(found[0], expected) and np.array_equal(found[1], expected)
    named = file.with_name('apart.onnx.sha256')
    named.write_text(f'{hashlib.sha256(file.read_bytes()).hexdigest()}  apart.onnx')
    assert np.array_equal(load(file).detect(image).bboxes_xyxy, expected)
    named.write_text('0' * 64)
    assert 'apart.onnx.sha256' in refusal(load, file)
    named.unlink()
    changed.unlink()
    assert place in refusal(load, file)


def test_a_folder_of_others_is_not_used(tmp_path, load, caplog):
    """Compiled networks and label embeddings: anyone could have written them."""
    cache = LabelCache(tmp_path / 'openvino')
    load(YOLO_FILE, cache_dir=str(tmp_path))
    cache.store('key', ['mug'], np.ones((1, 4), np.float32))
    before = {path: path.stat().st_mtime_ns for path in (tmp_path / 'openvino').iterdir()}
    (tmp_path / 'openvino').chmod(0o777)
    load(YOLO_FILE, cache_dir=str(tmp_path))
    assert cache.load('key', ['mug'], 4) is None
    cache.store('key', ['mug'], np.zeros((1, 4), np.float32))
    assert caplog.text.count('other users own its folder or can write to it') == 4
    assert before == {path: path.stat().st_mtime_ns for path in (tmp_path / 'openvino').iterdir()}


def test_a_damaged_compiled_network_is_compiled_again(tmp_path, caplog):
    image = cv2.imread(str(min((ASSETS / 'sequence/rgb').iterdir())))[..., ::-1]

    def boxes():
        return load_detector(DetectorOptions(str(YOLO_FILE), cache_dir=str(tmp_path))
                             ).detect(image).bboxes_xyxy

    before = boxes()
    blob, = tmp_path.rglob('*.blob')
    whole = blob.read_bytes()
    half = len(whole) // 2
    for damaged in (whole[:half] + bytes(3000) + whole[half + 3000:], whole[:1000], b''):
        blob.write_bytes(damaged)
        assert np.array_equal(boxes(), before)
        warning, = (record for record in caplog.records if record.levelname == 'WARNING')
        assert f'{blob} cannot be used' in warning.getMessage()
        caplog.clear()
        assert np.array_equal(boxes(), before) and not caplog.records
        assert [*blob.parent.iterdir()] == [blob]


def test_a_vocabulary_is_refused(load):
    with pytest.raises(OptionsError, match='has fixed classes'):
        load(YOLO_FILE, prompts=(('cup', 'cup'),))


@pytest.mark.parametrize(('model', 'expected'), [
    ('someone/d-fine@main:onnx/model_fp16.onnx', True), ('someone/d-fine.s-coco', True),
    ('some/d-fine:onnx/model_fp16.onnx', True), ('some/d-fine@refs/pr/1:model.onnx', True),
    ('some/d-fine@refs/pr/1', True), ('some/mine.onnx', False), ('some/d-fine@/main', False),
    ('yolov8n.pt', False), ('weights/mine.pt', False), ('some/where/mine', False), ('', False)])
def test_names_of_the_hub(model, expected, load, monkeypatch):
    monkeypatch.setenv('HTTPS_PROXY', 'http://127.0.0.1:1')
    assert is_hub_name(model) == expected
    if expected:  # and no local file
        assert 'cannot download' in refusal(load, model)


# ---- CLIP in files of transformers and open_clip. The towers are small: an embedding is a linear
# function of the mean colour, or the mean of the rows of the tokens in a table.
DIM, WORDS, CONTEXT = 8, 49_408, 77
RNG = np.random.default_rng(0)
OF_COLOUR = RNG.normal(size=(3, DIM)).astype(np.float32)
OF_TOKEN = RNG.normal(size=(WORDS, DIM)).astype(np.float32)
MEAN, STD = (0.4, 0.5, 0.6), (0.2, 0.3, 0.25)
#: Labels with their tokens, as open_clip and transformers have them.
TOKENS = {
    'a red mug': [320, 736, 9722],
    'Dining-table, 2.5m wide!!': [8658, 268, 2175, 267, 273, 269, 276, 332, 3184, 748],
    "the dog's bowls, don't": [518, 1929, 568, 17787, 267, 847, 713], 'Büro': [38706, 2795],
    'ﬁne ﬂoor': [3797, 4125], 'Ｗｉｄｅ': [3184], '&amp; &lt;b&gt;': [261, 283, 321, 285],
    'cafe\u0301': [15304], '': [], 'very ' * 90: [1070] * (CONTEXT - 2)}
START, END = 49406, 49407


def write_tower(file, given, nodes, constants, shape, kind, output):
    file.parent.mkdir(exist_ok=True)
    graph = helper.make_graph(
        nodes, 'tower', [helper.make_tensor_value_info(given, kind, ('n', *shape))],
        [helper.make_tensor_value_info(output, TensorProto.FLOAT, ('n', DIM))],
        [numpy_helper.from_array(value, name) for name, value in constants.items()])
    onnx.save(helper.make_model(graph, opset_imports=[helper.make_opsetid('', 17)], ir_version=9),
              file)


@pytest.fixture(scope='module')
def published(tmp_path_factory) -> Path:
    """Return a folder in the published layout of transformers."""
    folder = tmp_path_factory.mktemp('published')
    write_tower(folder / 'onnx/vision_model.onnx', 'pixel_values', [
        helper.make_node('ReduceMean', ['pixel_values'], ['mean'], axes=[2, 3], keepdims=0),
        helper.make_node('MatMul', ['mean', 'of_colour'], ['image_embeds'])],
        {'of_colour': OF_COLOUR}, (3, 224, 224), TensorProto.FLOAT, 'image_embeds')
    write_tower(folder / 'onnx/text_model.onnx', 'input_ids', [
        helper.make_node('Gather', ['of_token', 'input_ids'], ['rows']),
        helper.make_node('ReduceMean', ['rows'], ['text_embeds'], axes=[1], keepdims=0)],
        {'of_token': OF_TOKEN}, (CONTEXT,), TensorProto.INT64, 'text_embeds')
    (folder / 'config.json').write_text(json.dumps(
        {'model_type': 'clip', 'projection_dim': DIM, 'text_config': {}}))
    (folder / 'preprocessor_config.json').write_text(json.dumps({
        'crop_size': 224, 'size': {'shortest_edge': 224}, 'image_mean': MEAN, 'image_std': STD,
        'do_center_crop': True, 'do_normalize': True, 'resample': 3}))
    shutil.copy(ASSETS / 'clip/textual/tokenizer.json', folder)
    return folder


@pytest.fixture(scope='module')
def exported(published, tmp_path_factory) -> Path:
    """Return the same CLIP in the layout of export_network."""
    folder = tmp_path_factory.mktemp('exported')
    for name, tower in (('visual', 'vision'), ('textual', 'text')):
        (folder / name).mkdir()
        shutil.copy(published / f'onnx/{tower}_model.onnx', folder / name / 'model.onnx')
    shutil.copy(published / 'tokenizer.json', folder / 'textual')
    (folder / 'config.json').write_text(json.dumps({'embed_dim': DIM, 'text_cfg': {}}))
    (folder / 'visual/preprocess_cfg.json').write_text(json.dumps({
        'size': 224, 'mean': MEAN, 'std': STD, 'interpolation': 'bicubic',
        'resize_mode': 'shortest'}))
    describe_export(folder, 'clip:small')
    return folder


def load_clip(folder: Path, cache: Path) -> ClipEncoder:
    options = ClipOptions(pretrained=str(folder), cache_dir=str(cache))
    return ClipEncoder(resolve_clip_weights(options), options)


@pytest.mark.parametrize('layout', ['published', 'exported'])
def test_both_layouts_give_the_embeddings_of_their_towers(layout, cache, request):
    encoder = load_clip(request.getfixturevalue(layout), cache)
    colours = np.array([[10, 200, 90], [250, 0, 30]], np.uint8)  # RGB
    image = np.repeat(np.repeat(colours[None], 300, axis=0), 200, axis=1)
    crops = encoder.encode_crops(image, np.array([[20.0, 10, 180, 290], [210, 100, 390, 140]]))
    expected = unit_rows((colours / 255 - MEAN) / STD @ OF_COLOUR)
    np.testing.assert_allclose(crops, expected, atol=1e-2)  # may be encoded in bf16
    rows = [[START, *tokens, END] + [0] * (CONTEXT - 2 - len(tokens))
            for tokens in TOKENS.values()]
    clip = ClipOptions(pretrained=str(request.getfixturevalue(layout)), cache_dir=str(cache))
    labels = encode_labels(resolve_clip_weights(clip), list(TOKENS), clip)
    np.testing.assert_allclose(labels, unit_rows(OF_TOKEN[rows].mean(axis=1)), atol=1e-4)


def test_a_changed_export_has_another_key(exported, cache, tmp_path, caplog):
    changed = Path(shutil.copytree(exported, tmp_path / 'changed'))
    network = onnx.load(changed / 'visual/model.onnx')
    network.producer_name = 'someone'
    onnx.save(network, changed / 'visual/model.onnx')
    def key(folder):
        return resolve_clip_weights(ClipOptions(pretrained=str(folder), cache_dir=str(cache))).key

    assert key(exported) == 'clip:small' and not caplog.records
    assert key(changed).startswith('onnx:') and 'differs from its digest' in caplog.text
    for content in ('{"files": 3, "key": "x"}', '[]', '{"files": {"gone": 0}, "key": "x"}'):
        (changed / 'export.json').write_text(content)
        assert key(changed).startswith('onnx:')


def text_of(file: Path, **changes) -> None:
    file.write_text(json.dumps(json.loads(file.read_text()) | changes))


def other_words(file: Path) -> None:
    """Write the tokenizer of another model."""
    tokenizer = Tokenizer(models.WordLevel({'[UNK]': 0, '[CLS]': 1, '[SEP]': 2} | {
        f'word{number}': number for number in range(3, 30)}, '[UNK]'))
    tokenizer.pre_tokenizer = pre_tokenizers.Whitespace()
    tokenizer.post_processor = processors.TemplateProcessing(
        single='[CLS] $0 [SEP]', special_tokens=[('[CLS]', 1), ('[SEP]', 2)])
    tokenizer.save(str(file))


@pytest.mark.parametrize(('change', 'named'), [
    (lambda folder: (folder / 'config.json').unlink(), 'config.json is missing'),
    (lambda folder: text_of(folder / 'config.json', projection_dim=99), 'expected one output'),
    (lambda folder: text_of(folder / 'preprocessor_config.json', crop_size=256), '256 x 256'),
    *((lambda folder, change=change: text_of(folder / 'preprocessor_config.json', **change),
       f"'{next(iter(change))}'") for change in (
           {'image_std': [0, 1, 1]}, {'resample': [3]}, {'rescale_factor': 300})),
    (lambda folder: (folder / 'tokenizer.json').unlink(), 'tokenizer.json is missing'),
    (lambda folder: (folder / 'tokenizer.json').write_text('{}'), 'not a tokenizer of a CLIP'),
    (lambda folder: text_of(folder / 'tokenizer.json', model=json.loads(  # it ended the process
        (folder / 'tokenizer.json').read_text())['model'] | {'continuing_subword_prefix': 'a'}),
     'not a tokenizer of a CLIP'),
    (lambda folder: other_words(folder / 'tokenizer.json'), 'it has 30 tokens, but the text'),
    (lambda folder: shutil.copy(ASSETS / 'yolo.onnx', folder / 'onnx/text_model.onnx'),
     'takes no tokens'),
])
def test_what_is_no_clip(published, cache, tmp_path, change, named):
    folder = Path(shutil.copytree(published, tmp_path / 'clip'))
    change(folder)
    clip = ClipOptions(pretrained=str(folder), cache_dir=str(cache))
    with pytest.raises(ModelError) as caught:
        ClipEncoder(resolve_clip_weights(clip), clip)
        encode_labels(resolve_clip_weights(clip), ['a cup'], clip)
    assert named in str(caught.value) and str(folder) in str(caught.value)


def test_a_folder_may_have_the_name_of_a_tag(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / 'openai').mkdir()
    assert not names_onnx(ClipOptions('ViT-B-32', 'openai'))
    assert not names_onnx(ClipOptions('ViT-B-32', ''))
    assert names_onnx(ClipOptions('', './openai')) and names_onnx(ClipOptions('', 'some/one'))
