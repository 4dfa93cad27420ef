# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Exports to ONNX give the same results as PyTorch, even if their cache is damaged."""

import gc
import logging
import os
import shutil
import subprocess
import sys
import warnings
from pathlib import Path

import cv2
import numpy as np
import open_clip
import pytest
import torch
from clip_reference import Reference
from onnx_exports import NAMES, SIDE, an_image, export_yolo, make_d_fine, pixels

from cliploc_ros.cli.export_network import main as export_network
from cliploc_ros.errors import ModelError
from cliploc_ros.models.clip_encoder import ClipEncoder
from cliploc_ros.models.clip_weights import ClipOptions, resolve_clip_weights
from cliploc_ros.models.images import crop_bounds
from cliploc_ros.models.onnx_clip import OnnxTextTower
from cliploc_ros.models.profiles import load_detector
from cliploc_ros.models.protocols import DetectorOptions, ObjectDetector

pytestmark = pytest.mark.full

PROJECT = Path(__file__).resolve().parents[2]
ASSETS = PROJECT / 'demo/assets'
rng = np.random.default_rng(2)
CORNERS = rng.uniform(0, 400, (12, 2))
BBOXES = np.hstack([CORNERS, CORNERS + rng.uniform(5, 230, (12, 2))])


def load(reference, cache, **changes) -> ClipEncoder:
    options = ClipOptions(**{
        'model': reference.name, 'pretrained': str(reference.file), 'device': 'cpu',
        'cache_dir': str(cache), 'inference': 'openvino', 'precision': 'fp32', **changes})
    return ClipEncoder(resolve_clip_weights(options), options)


@pytest.fixture(scope='session')
def demo_clip() -> Reference:
    open_clip.add_model_config(ASSETS / 'clip.json')
    model, _, preprocess = open_clip.create_model_and_transforms(
        'clip', pretrained=str(ASSETS / 'clip.safetensors'), force_custom_text=True)
    return Reference('clip', ASSETS / 'clip.safetensors', model.eval(), preprocess, None)


@pytest.fixture(scope='session')
def cache(tmp_path_factory) -> Path:
    return tmp_path_factory.mktemp('cache')


@pytest.fixture(scope='session')
def demo_rgb() -> list[np.ndarray]:
    files = sorted((ASSETS / 'sequence/rgb').iterdir())[::24]
    return [cv2.cvtColor(cv2.imread(str(file)), cv2.COLOR_BGR2RGB) for file in files]


@pytest.mark.parametrize('precision', ['fp32', 'auto'])
@pytest.mark.parametrize('name', ['demo_clip', 'large_clip'])
def test_embeddings_equal_those_of_open_clip(name, precision, request, cache, image_rgb):
    reference = request.getfixturevalue(name)
    encoder = load(reference, cache, precision=precision)
    assert encoder.inference == 'openvino' and encoder.device == 'cpu'
    assert encoder.key == load(reference, cache, inference='pytorch').key
    expected = reference.crops(image_rgb, crop_bounds(BBOXES, 640, 480))
    crops = encoder.encode_crops(image_rgb, BBOXES)
    cosine = (crops * expected).sum(axis=1).min()
    print(f'\n{reference.name}, {precision}: least cosine to open_clip {cosine:.7f}')
    assert cosine > (0.999999 if precision == 'fp32' else 0.999)
    assert crops.dtype == np.float32 and crops.shape == expected.shape
    # the batch size has no influence
    alone = encoder.encode_crops(image_rgb, BBOXES[:1])
    assert alone[0] @ crops[0] > (0.999999 if precision == 'fp32' else 0.999)
    assert encoder.encode_crops(image_rgb, BBOXES[:0]).shape == (0, encoder.embed_dim)


def test_a_second_start_neither_exports_nor_builds_the_tower_in_pytorch(
        demo_clip, cache, caplog):
    load(demo_clip, cache)
    caplog.clear()
    gc.collect()
    kept = {id(thing) for thing in gc.get_objects() if issubclass(type(thing), torch.nn.Parameter)}
    with caplog.at_level(logging.INFO):
        encoder = load(demo_clip, cache)
    made = [thing for thing in gc.get_objects() if issubclass(type(thing), torch.nn.Parameter)
            and id(thing) not in kept and not thing.is_meta]
    assert encoder.inference == 'openvino' and made == [] and caplog.text == ''


@pytest.fixture(scope='module')
def small_cache(small_clip, tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp('small_cache')
    load(small_clip, folder)
    return folder


def change(file: Path) -> None:
    with file.open('r+b') as opened:
        opened.seek(50_000)
        opened.write(bytes(5_000))


@pytest.mark.parametrize(('damage', 'warns'), [
    (lambda cache: os.truncate(next(cache.glob('onnx/*/visual/model.onnx')), 1000), 'exporting'),
    (lambda cache: next(cache.glob('onnx/*/export.json')).write_text('{}'), 'exporting'),
    (lambda cache: change(next(cache.glob('openvino/*/network.blob'))), 'compiling'),
    (lambda cache: os.truncate(next(cache.glob('openvino/*/network.blob')), 1000), 'compiling'),
    (lambda cache: next(cache.glob('openvino/*/about.json')).write_text(''), 'compiling')])
def test_a_damaged_cache_is_made_anew(small_clip, small_cache, tmp_path, image_rgb, caplog,
                                      damage, warns):
    shutil.copytree(small_cache, tmp_path, dirs_exist_ok=True)
    before = load(small_clip, small_cache).encode_crops(image_rgb, BBOXES)
    damage(tmp_path)
    caplog.clear()
    assert np.array_equal(load(small_clip, tmp_path).encode_crops(image_rgb, BBOXES), before)
    warning, = (record for record in caplog.records if record.levelno >= logging.WARNING)
    assert warns in warning.getMessage() and str(tmp_path) in warning.getMessage()
    caplog.clear()
    assert np.array_equal(load(small_clip, tmp_path).encode_crops(image_rgb, BBOXES), before)
    assert not any(record.levelno >= logging.WARNING for record in caplog.records)
    for kind in ('onnx', 'openvino'):
        assert not any(entry.name.startswith('.') for entry in (tmp_path / kind).iterdir())


MISSING = """
import logging, sys
sys.modules['openvino'] = None  # as where it is not installed
logging.basicConfig(level=logging.INFO, format='%(levelname)s %(message)s')
from cliploc_ros.errors import OptionsError
from cliploc_ros.models.profiles import load_detector
from cliploc_ros.models.profiles import load_detector
from cliploc_ros.models.protocols import DetectorOptions, ObjectDetector
for _ in range(2):
    assert load_detector(DetectorOptions(sys.argv[1], device='cpu')).inference == 'pytorch'
try:
    load_detector(DetectorOptions(sys.argv[1], device='cpu', inference='openvino'))
except OptionsError as error:
    print(error)
"""


def test_without_openvino_pytorch_runs_and_one_line_says_so():
    done = subprocess.run([sys.executable, '-c', MISSING, str(ASSETS / 'yolo.pt')], cwd=PROJECT,
                          capture_output=True, text=True, timeout=300, check=False)
    assert done.returncode == 0, done.stderr
    line, = (line for line in done.stderr.splitlines() if 'OpenVINO' in line)
    assert line.startswith('INFO ') and 'pip install openvino' in line
    assert 'is not installed' in done.stdout


def test_pytorch_runs_a_network_whose_export_gives_other_results(small_clip, tmp_path, caplog):
    state = {name: torch.full_like(tensor, float('nan'))
             for name, tensor in small_clip.model.state_dict().items()}
    torch.save(state, tmp_path / 'weights.pt')
    changes = {'pretrained': str(tmp_path / 'weights.pt')}
    with pytest.raises(ModelError, match='small-clip'):
        load(small_clip, tmp_path, **changes)
    with pytest.raises(ModelError, match='not finite'):  # says PyTorch
        load(small_clip, tmp_path, inference='auto', **changes)
    assert 'PyTorch runs it' in caplog.text
    assert not (tmp_path / 'onnx').exists()


def compare(first: ObjectDetector, second: ObjectDetector, images: list[np.ndarray]) -> float:
    """Return the largest difference of two detectors' boxes [px]."""
    differences = [0.0]
    for image in images:
        found, again = first.detect(image), second.detect(image)
        assert found.class_ids == again.class_ids
        assert np.allclose(found.scores, again.scores, atol=1e-2)
        differences += np.abs(found.bboxes_xyxy - again.bboxes_xyxy).ravel().tolist()
    assert len(differences) > 4 * 20
    return max(differences)


def detector(model: object, cache: Path, **changes) -> ObjectDetector:
    return load_detector(DetectorOptions(str(model), device='cpu', cache_dir=str(cache),
                                         **changes))


@pytest.fixture(scope='session')
def weights(shared_data) -> Path:
    return shared_data / 'weights/yolov8n_coco.pt'


@pytest.mark.parametrize('settings', [
    None, {'dynamic': True}, {}, {'nms': True, 'conf': 0.1, 'iou': 0.7, 'agnostic_nms': False}])
def test_boxes_in_real_images_equal_those_of_pytorch(settings, weights, shared_data, cache,
                                                     tmp_path):
    """Without settings, the weights are exported at their first use."""
    images = [cv2.cvtColor(cv2.imread(str(file)), cv2.COLOR_BGR2RGB)
              for file in sorted((shared_data / 'tum_fr3_office/rgb').iterdir())[::3]]
    file = weights if settings is None else export_yolo(weights, tmp_path, **settings)
    if settings is not None and not settings.get('dynamic'):  # as exports of fixed size see them
        images = [cv2.copyMakeBorder(image, 80, 80, 0, 0, cv2.BORDER_CONSTANT, value=(114,) * 3)
                  for image in images]
    exported = detector(file, cache)
    assert exported.inference == 'openvino' and len(exported.class_names) == 80
    largest = compare(exported, detector(weights, cache, inference='pytorch'), images)
    print(f'\nlargest difference of a box: {largest:.5f} px')
    assert largest < 0.5


@pytest.mark.needs('transformers')
def test_boxes_of_d_fine_equal_those_of_the_library(tmp_path, cache):
    """The published file cannot be downloaded here: the network has random weights."""
    import transformers

    network, image = make_d_fine(tmp_path), an_image(SIDE, SIDE)
    exported = detector(tmp_path, cache, conf=0.0, iou=1.0)
    assert (exported.class_names, exported.device) == (NAMES, 'cpu')
    found = exported.detect(image)
    with torch.inference_mode():
        outputs = network(torch.from_numpy(pixels(image)))
    theirs = transformers.RTDetrImageProcessor().post_process_object_detection(
        outputs, threshold=0.0, target_sizes=[(SIDE, SIDE)])[0]
    assert found.class_ids == tuple(NAMES[int(number)] for number in theirs['labels'])
    px = np.abs(found.bboxes_xyxy - np.clip(theirs['boxes'].numpy(), 0, SIDE)).max()
    score = np.abs(found.scores - theirs['scores'].numpy()).max()
    print(f'\nboxes at most {px:.5f} px apart, scores {score:.6f}')
    assert px < 0.5 and score < 0.01


LABELS = ['a red mug', 'Dining-table, 2.5m wide!!', "the dog's bowls, don't", 'Büro', 'very ' * 90]
CROPS = np.array([[10.0, 20, 210, 220], [0, 0, 640, 480], [300, 100, 330, 400]])


def load_folder(folder: Path, cache: Path) -> tuple[ClipEncoder, ClipOptions]:
    options = ClipOptions(pretrained=str(folder), device='cpu', cache_dir=str(cache),
                          precision='fp32')
    return ClipEncoder(resolve_clip_weights(options), options), options


@pytest.fixture(scope='module')
def exported(small_clip, tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp('export') / 'small'
    config = small_clip.file.with_suffix('.json')
    assert export_network(['--clip-model', str(config), '--clip-pretrained', str(small_clip.file),
                           '--out', str(folder)]) == 0
    return folder


def test_an_export_gives_the_embeddings_of_open_clip(small_clip, exported, cache, image_rgb):
    assert exported.stat().st_mode & 0o055 == 0o055, 'other users may read it'
    encoder, _ = load_folder(exported, cache)
    bounds = CROPS.astype(int)
    cosines = [np.sum(encoder.encode_crops(image_rgb, CROPS)
                      * small_clip.crops(image_rgb, bounds), axis=1),
               np.sum(encoder.encode_labels(LABELS) * small_clip.labels(LABELS), axis=1)]
    print(f'\nleast cosine to open_clip: crops {cosines[0].min():.7f}, '
          f'labels {cosines[1].min():.7f}')
    assert min(map(np.min, cosines)) > 0.9999
    # embeddings that were made of the weights stay valid
    torch_options = ClipOptions(small_clip.name, str(small_clip.file), inference='pytorch')
    assert encoder.key == resolve_clip_weights(torch_options).key


def test_tokens_equal_those_of_open_clip(exported, cache):
    rng = np.random.default_rng(0)
    letters = [*"abcdefghijklmnopqrstuvwxyz ABC 0123 '-_.,!?&;<>\"’“äöüßéñ",
               *'椅子ﬁﬂＷ½\u0301🙂\u00a0\t']
    texts = [''.join(rng.choice(letters, rng.integers(0, 30))) for _ in range(10_000)]
    texts += [*LABELS, 'cafe\u0301', '½ pint ²', '', '&amp; &lt;b&gt;', '‘quoted’ “x”', 'aaaaaaa',
              'ﬁne ﬂoor', 'Ｗｉｄｅ', "''s", 'İstanbul', '<start_of_text> x']
    options = ClipOptions(pretrained=str(exported), device='cpu', cache_dir=str(cache))
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
    encoder, _ = load_folder(folder, cache)
    crop = image_rgb[20:220, 10:210]
    with torch.no_grad():
        pixels = transformers.CLIPImageProcessor()(crop, return_tensors='pt')['pixel_values']
        image = vision(pixels).image_embeds.numpy()[0]
        tokens = open_clip.get_tokenizer('ViT-B-32')(['a red mug'])
        label = text(tokens).text_embeds.numpy()[0]
    for found, expected in ((encoder.encode_crops(image_rgb, CROPS[:1])[0], image),
                            (encoder.encode_labels(['a red mug'])[0], label)):
        assert found @ expected / np.linalg.norm(expected) > 0.9999


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
