# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""CLIP in ONNX files of transformers and open_clip, and files that are not CLIP.

The towers are small: an image's embedding is a linear function of its mean colour, a label's is
the mean of its tokens' rows in a table.
"""

import json
import shutil
from pathlib import Path

import numpy as np
import onnx
import pytest
from onnx import TensorProto, helper, numpy_helper
from tokenizers import Tokenizer, models, pre_tokenizers, processors

from cliploc_ros.errors import ModelError
from cliploc_ros.models.clip_encoder import ClipEncoder, encode_labels
from cliploc_ros.models.exports import describe_export
from cliploc_ros.models.onnx_clip import names_onnx, resolve_clip_weights
from cliploc_ros.models.protocols import ClipOptions
from demo import ASSETS

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


@pytest.fixture(scope='module')
def cache(tmp_path_factory) -> str:
    return str(tmp_path_factory.mktemp('cache'))


def load(folder: Path, cache: str) -> ClipEncoder:
    options = ClipOptions(pretrained=str(folder), cache_dir=cache)
    return ClipEncoder(resolve_clip_weights(options), options)


def unit(rows):
    return rows / np.linalg.norm(rows, axis=1, keepdims=True)


@pytest.mark.parametrize('layout', ['published', 'exported'])
def test_both_layouts_give_the_embeddings_of_their_towers(layout, cache, request):
    encoder = load(request.getfixturevalue(layout), cache)
    colours = np.array([[10, 200, 90], [250, 0, 30]], np.uint8)  # RGB
    image = np.repeat(np.repeat(colours[None], 300, axis=0), 200, axis=1)
    crops = encoder.encode_crops(image, np.array([[20.0, 10, 180, 290], [210, 100, 390, 140]]))
    expected = unit((colours / 255 - MEAN) / STD @ OF_COLOUR)
    np.testing.assert_allclose(crops, expected, atol=1e-2)  # may be encoded in bf16
    rows = [[START, *tokens, END] + [0] * (CONTEXT - 2 - len(tokens))
            for tokens in TOKENS.values()]
    clip = ClipOptions(pretrained=str(request.getfixturevalue(layout)), cache_dir=cache)
    labels = encode_labels(resolve_clip_weights(clip), list(TOKENS), clip)
    np.testing.assert_allclose(labels, unit(OF_TOKEN[rows].mean(axis=1)), atol=1e-4)


def test_a_changed_export_has_another_key(exported, cache, tmp_path):
    changed = Path(shutil.copytree(exported, tmp_path / 'changed'))
    network = onnx.load(changed / 'visual/model.onnx')
    network.producer_name = 'someone'
    onnx.save(network, changed / 'visual/model.onnx')
    def key(folder):
        return resolve_clip_weights(ClipOptions(pretrained=str(folder), cache_dir=cache)).key

    assert key(exported) == 'clip:small' and key(changed).startswith('onnx:')
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
    (lambda folder: text_of(folder / 'preprocessor_config.json', image_std=[0, 1, 1]), 'deviat'),
    (lambda folder: (folder / 'tokenizer.json').unlink(), 'tokenizer.json is missing'),
    (lambda folder: (folder / 'tokenizer.json').write_text('{}'), 'not a tokenizer of a CLIP'),
    (lambda folder: other_words(folder / 'tokenizer.json'), 'it has 30 tokens, but the text'),
    (lambda folder: shutil.copy(ASSETS / 'yolo.onnx', folder / 'onnx/text_model.onnx'),
     'takes no tokens'),
])
def test_what_is_no_clip(published, cache, tmp_path, change, named):
    folder = Path(shutil.copytree(published, tmp_path / 'clip'))
    change(folder)
    clip = ClipOptions(pretrained=str(folder), cache_dir=cache)
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
