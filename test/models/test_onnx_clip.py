# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""CLIP in ONNX files of transformers and open_clip, and files that are not CLIP.

Published files cannot be downloaded here, so the networks have random weights.
"""

import json
import shutil
import warnings
from pathlib import Path

import numpy as np
import onnx
import open_clip
import pytest
import torch
from tokenizers import Tokenizer, models, pre_tokenizers, processors

from cliploc_ros.cli.export_network import main as export_network
from cliploc_ros.errors import ModelError, OptionsError
from cliploc_ros.models.clip_encoder import ClipEncoder, encode_labels
from cliploc_ros.models.clip_weights import ClipOptions, names_onnx, resolve_clip_weights
from cliploc_ros.models.onnx_clip import OnnxTextTower
from demo import ASSETS

pytestmark = pytest.mark.full
LABELS = ['a red mug', 'Dining-table, 2.5m wide!!', "the dog's bowls, don't", 'Büro', 'very ' * 90]
BBOXES = np.array([[10.0, 20, 210, 220], [0, 0, 640, 480], [300, 100, 330, 400]])


@pytest.fixture(scope='module')
def cache(tmp_path_factory) -> str:
    return str(tmp_path_factory.mktemp('cache'))


@pytest.fixture(scope='module')
def exported(small_clip, tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp('export') / 'small'
    config = small_clip.file.with_suffix('.json')
    assert export_network(['--clip-model', str(config), '--clip-pretrained', str(small_clip.file),
                           '--out', str(folder)]) == 0
    return folder


def load(folder: Path, cache: str, **changes) -> tuple[ClipEncoder, ClipOptions]:
    options = ClipOptions(pretrained=str(folder), device='cpu', cache_dir=cache,
                          **{'precision': 'fp32', **changes})
    return ClipEncoder(resolve_clip_weights(options), options), options


def test_an_export_gives_the_embeddings_of_open_clip(small_clip, exported, cache, image_rgb):
    assert exported.stat().st_mode & 0o055 == 0o055, 'other users may read it'
    encoder, options = load(exported, cache)
    bounds = BBOXES.astype(int)
    cosines = [np.sum(encoder.encode_crops(image_rgb, BBOXES)
                      * small_clip.crops(image_rgb, bounds), axis=1),
               np.sum(encoder.encode_labels(LABELS) * small_clip.labels(LABELS), axis=1)]
    print(f'\nleast cosine to open_clip: crops {cosines[0].min():.7f}, '
          f'labels {cosines[1].min():.7f}')
    assert min(map(np.min, cosines)) > 0.9999
    # embeddings that were made of the weights stay valid
    torch_options = ClipOptions(small_clip.name, str(small_clip.file), inference='pytorch')
    assert encoder.key == resolve_clip_weights(torch_options).key
    with pytest.raises(OptionsError, match='runs in OpenVINO'):
        encode_labels(resolve_clip_weights(options), LABELS,
                      ClipOptions(pretrained=str(exported), inference='pytorch'))


def test_a_changed_export_has_another_key(exported, cache, tmp_path):
    changed = Path(shutil.copytree(exported, tmp_path / 'changed'))
    network = onnx.load(changed / 'visual/model.onnx')
    network.producer_name = 'someone'
    onnx.save(network, changed / 'visual/model.onnx')
    def key(folder):
        return resolve_clip_weights(ClipOptions(pretrained=str(folder), cache_dir=cache)).key

    assert key(exported) != key(changed) and key(changed).startswith('onnx:')
    for content in ('{"files": 3, "key": "x"}', '[]', '{"files": {"gone": 0}, "key": "x"}'):
        (changed / 'export.json').write_text(content)
        assert key(changed).startswith('onnx:')


def test_tokens_equal_those_of_open_clip(exported, cache):
    rng = np.random.default_rng(0)
    letters = [*"abcdefghijklmnopqrstuvwxyz ABC 0123 '-_.,!?&;<>\"’“äöüßéñ",
               *'椅子ﬁﬂＷ½\u0301🙂\u00a0\t']
    texts = [''.join(rng.choice(letters, rng.integers(0, 30))) for _ in range(10_000)]
    texts += [*LABELS, 'cafe\u0301', '½ pint ²', '', '&amp; &lt;b&gt;', '‘quoted’ “x”', 'aaaaaaa',
              'ﬁne ﬂoor', 'Ｗｉｄｅ', "''s", 'İstanbul', '<start_of_text> x']
    options = ClipOptions(pretrained=str(exported), device='cpu', cache_dir=cache)
    found, _ = OnnxTextTower(resolve_clip_weights(options), options).tokens(texts)
    assert np.array_equal(found, open_clip.get_tokenizer('ViT-B-32')(texts).numpy())


class _Embeddings(torch.nn.Module):
    def __init__(self, network: torch.nn.Module, kind: str) -> None:
        super().__init__()
        self.network, self.kind = network, kind

    def forward(self, inputs: torch.Tensor) -> torch.Tensor:
        return getattr(self.network(inputs), self.kind)


@pytest.fixture(scope='module')
def published(exported, tmp_path_factory):
    """Return a folder in the published layout of transformers, and the networks in PyTorch."""
    transformers = pytest.importorskip('transformers')
    torch.manual_seed(0)
    small = {'hidden_size': 32, 'intermediate_size': 64, 'num_hidden_layers': 2,
             'num_attention_heads': 2}
    config = transformers.CLIPConfig(text_config=small, vision_config=small, projection_dim=24)
    networks = (transformers.CLIPVisionModelWithProjection(config.vision_config),
                transformers.CLIPTextModelWithProjection(config.text_config))
    folder = tmp_path_factory.mktemp('published')
    (folder / 'onnx').mkdir()
    size = config.vision_config.projection_dim
    config.projection_dim = size
    config.save_pretrained(folder)
    transformers.CLIPImageProcessor().save_pretrained(folder)
    shutil.copy(exported / 'textual/tokenizer.json', folder)
    for network, name, kind, example in zip(
            networks, ('vision', 'text'), ('image_embeds', 'text_embeds'),
            (torch.zeros(2, 3, 224, 224), torch.full((2, 77), 49407)), strict=True):
        with warnings.catch_warnings(), torch.no_grad():
            warnings.simplefilter('ignore')
            given = 'pixel_values' if name == 'vision' else 'input_ids'
            torch.onnx.export(_Embeddings(network, kind).eval(), (example,),
                              folder / f'onnx/{name}_model.onnx', input_names=[given],
                              output_names=[kind], dynamo=False, opset_version=17,
                              dynamic_axes={given: {0: 'n'}, kind: {0: 'n'}})
    return folder, [network.eval() for network in networks]


@pytest.mark.needs('transformers')
def test_the_layout_of_transformers(published, cache, image_rgb):
    import transformers

    folder, (vision, text) = published
    encoder, _ = load(folder, cache)
    crop = image_rgb[20:220, 10:210]
    with torch.no_grad():
        pixels = transformers.CLIPImageProcessor()(crop, return_tensors='pt')['pixel_values']
        image = vision(pixels).image_embeds.numpy()[0]
        tokens = open_clip.get_tokenizer('ViT-B-32')(['a red mug'])
        label = text(tokens).text_embeds.numpy()[0]
    for found, expected in ((encoder.encode_crops(image_rgb, BBOXES[:1])[0], image),
                            (encoder.encode_labels(['a red mug'])[0], label)):
        assert found @ expected / np.linalg.norm(expected) > 0.9999


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
    (lambda folder: text_of(folder / 'config.json', projection_dim='x'), "'projection_dim'"),
    (lambda folder: text_of(folder / 'config.json', projection_dim=True), "'projection_dim'"),
    (lambda folder: text_of(folder / 'config.json', projection_dim=99), 'expected one output'),
    (lambda folder: (folder / 'preprocessor_config.json').unlink(), 'preprocessor_config.json is'),
    (lambda folder: text_of(folder / 'preprocessor_config.json', image_mean=[1]), 'standard dev'),
    (lambda folder: text_of(folder / 'preprocessor_config.json', crop_size=256), '256 x 256'),
    (lambda folder: text_of(folder / 'preprocessor_config.json', crop_size=10**9), 'up to 2048'),
    (lambda folder: text_of(folder / 'preprocessor_config.json', image_std=[0, 1, 1]), 'deviat'),
    (lambda folder: (folder / 'onnx/vision_model.onnx').unlink(), 'vision_model.onnx'),
    (lambda folder: (folder / 'onnx/text_model.onnx').unlink(), 'text_model.onnx'),
    (lambda folder: (folder / 'tokenizer.json').unlink(), 'tokenizer.json is missing'),
    (lambda folder: (folder / 'tokenizer.json').write_text('{}'), 'not a tokenizer of a CLIP'),
    (lambda folder: other_words(folder / 'tokenizer.json'), 'it has 30 tokens, but the text'),
    (lambda folder: shutil.copy(ASSETS / 'yolo.onnx', folder / 'onnx/vision_model.onnx'),
     'expected one output'),
    (lambda folder: shutil.copy(ASSETS / 'yolo.onnx', folder / 'onnx/text_model.onnx'),
     'takes no tokens'),
])
def test_what_is_no_clip(published, cache, tmp_path, change, named):
    folder = Path(shutil.copytree(published[0], tmp_path / 'clip'))
    change(folder)
    with pytest.raises(ModelError) as caught:
        load(folder, cache)[0].encode_labels(['a cup'])
    assert named in str(caught.value) and str(folder) in str(caught.value)


def test_a_folder_may_have_the_name_of_a_tag(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / 'openai').mkdir()
    assert not names_onnx(ClipOptions('ViT-B-32', 'openai'))
    assert not names_onnx(ClipOptions('ViT-B-32', ''))
    assert names_onnx(ClipOptions('', './openai')) and names_onnx(ClipOptions('', 'some/one'))


def test_a_network_is_exported_to_a_new_place_only(exported, tmp_path, capsys):
    for arguments, named in ((['--clip-model', 'x'], 'exists'), ([], 'name either a detector'),
                             (['--model', 'x.pt'], 'exists'),
                             (['--clip-model', 'x', '--model', 'y'], 'name either')):
        assert export_network([*arguments, '--out', str(exported)]) == 1
        assert named in capsys.readouterr().err
    assert export_network(['--model', str(ASSETS / 'yolo.pt'), '--out', 'yolo.pt']) == 1
    file = tmp_path / 'own.onnx'
    assert export_network(['--model', str(ASSETS / 'yolo.pt'), '--out', str(file)]) == 0
    assert f'{file}: ' in capsys.readouterr().out and file.stat().st_size > 4e6
