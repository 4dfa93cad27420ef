# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Exported detectors give the boxes of ultralytics and transformers; vocabularies; profiles."""

import json
import os
import shutil
import subprocess
import sys
import warnings
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from scene import make_room
from without_pytorch import Lazy, hide_pytorch

from cliploc_ros.cli import evaluate
from cliploc_ros.errors import ModelError, OptionsError
from cliploc_ros.models import protocols
from cliploc_ros.models.files import is_hub_name
from cliploc_ros.models.onnx_detector import load_detector
from cliploc_ros.models.yolo_weights import import_ultralytics, load_yolo
from cliploc_ros.offline.datasets.frames import Frames
from cliploc_ros.offline.recording.recorder import EVERY_FRAME, RecordingOptions, describe
from demo import ASSETS

pytestmark = pytest.mark.full
open_clip, open_weights, ops, torch = map(Lazy, (
    'open_clip', 'open_weights', 'torchvision.ops', 'torch'))

PROJECT = Path(__file__).resolve().parents[2]


@pytest.fixture(scope='session')
def weights(shared_data) -> Path:
    return shared_data / 'weights/yolov8n_coco.pt'


@pytest.fixture(scope='session')
def cache(tmp_path_factory) -> Path:
    return tmp_path_factory.mktemp('cache')


@pytest.fixture(scope='session')
def office_rgb(shared_data) -> list[np.ndarray]:
    return [cv2.cvtColor(cv2.imread(str(file)), cv2.COLOR_BGR2RGB)
            for file in sorted((shared_data / 'tum_fr3_office/rgb').iterdir())[::4]]


def detector(model: object, cache: Path, **changes) -> protocols.ObjectDetector:
    return load_detector(protocols.DetectorOptions(str(model), cache_dir=str(cache), **changes))


def by_ultralytics(model, image_rgb, **changes):
    """Return boxes and classes by the code of ultralytics."""
    found = model.predict(np.ascontiguousarray(image_rgb[..., ::-1]), verbose=False, device='cpu',
                          **{'conf': 0.1, 'iou': 0.7, 'imgsz': 640} | changes)[0].boxes
    rows = found.data.numpy()
    return rows, [model.names[int(number)] for number in rows[:, 5]]


@pytest.mark.parametrize('settings', [
    None, {'nms': True, 'conf': 0.1, 'iou': 0.7, 'agnostic_nms': False}])
def test_boxes_in_real_images_equal_those_of_pytorch(settings, weights, office_rgb, cache,
                                                     tmp_path):
    """Without settings, the weights are exported at their first use; else by ultralytics."""
    file, images = weights, office_rgb
    if settings is not None:
        shutil.copy(weights, tmp_path / 'yolo.pt')
        file = import_ultralytics().YOLO(tmp_path / 'yolo.pt').export(
            format='onnx', simplify=False, verbose=False, **settings)
        if not settings.get('dynamic'):  # as exports of fixed size see them
            images = [cv2.copyMakeBorder(image, 80, 80, 0, 0, cv2.BORDER_CONSTANT,
                                         value=(114,) * 3) for image in images]
    exported, model, largest = detector(file, cache), load_yolo(weights), 0.0
    assert len(exported.class_names) == 80
    for image in images:
        found, (rows, classes) = exported.detect(image), by_ultralytics(model, image)
        assert len(rows) > 4 and list(found.class_ids) == classes
        assert np.allclose(found.scores, rows[:, 4], atol=1e-2) and found.scores.dtype == float
        largest = max(largest, float(np.abs(found.bboxes_xyxy - rows[:, :4]).max()))
    print(f'\nlargest difference of a box: {largest:.5f} px')
    assert largest < 0.5


NAMES, SIDE = ('chair', 'cup', 'dining table'), 128
SMALL = {'encoder_hidden_dim': 32, 'encoder_ffn_dim': 32, 'd_model': 32, 'num_queries': 12,
         'decoder_ffn_dim': 32, 'decoder_attention_heads': 4, 'encoder_attention_heads': 4,
         'decoder_layers': 2, 'encoder_layers': 1, 'id2label': dict(enumerate(NAMES)),
         'encoder_in_channels': [24, 32, 40], 'decoder_in_channels': [32] * 3}


@pytest.mark.needs('transformers')
def test_boxes_of_d_fine_equal_those_of_the_library(tmp_path, cache):
    """The published file cannot be downloaded here: the network has random weights."""
    import transformers

    torch.manual_seed(0)
    backbone = transformers.HGNetV2Config(
        stem_channels=[3, 8, 8], hidden_sizes=[16, 24, 32, 40], depths=[1, 1, 1, 1],
        stage_in_channels=[8, 16, 24, 32], stage_mid_channels=[8, 8, 8, 8],
        stage_out_channels=[16, 24, 32, 40], stage_num_blocks=[1, 1, 1, 1],
        stage_numb_of_layers=[1, 1, 1, 1], out_features=['stage2', 'stage3', 'stage4'])
    network = transformers.DFineForObjectDetection(transformers.DFineConfig(
        backbone_config=backbone, **SMALL)).eval()
    for module in network.modules():  # else all places have nearly equal features
        if hasattr(module, 'running_var'):
            module.running_var.uniform_(0.1, 0.3)
            module.running_mean.normal_(0.0, 0.1)
    torch.nn.init.normal_(network.model.enc_score_head.weight, 0.0, 1.0)
    network.config.save_pretrained(tmp_path)
    transformers.RTDetrImageProcessor(size={'height': SIDE, 'width': SIDE}
                                      ).save_pretrained(tmp_path)
    (tmp_path / 'onnx').mkdir()
    image = np.random.default_rng(0).integers(0, 256, (SIDE, SIDE, 3), dtype=np.uint8)
    given = torch.from_numpy(np.float32(image.transpose(2, 0, 1)[None]) / np.float32(255))
    with warnings.catch_warnings(), torch.no_grad():
        warnings.simplefilter('ignore')
        # The exporter leaves all submodules of a module in its training mode.
        torch.onnx.export(open_weights.OnlyResults(network).eval(), (given,),
                          tmp_path / 'onnx/model.onnx',
                          input_names=['pixel_values'], output_names=['logits', 'pred_boxes'],
                          dynamo=False, opset_version=17)
        outputs = network(given)
    exported = detector(tmp_path, cache, conf=0.0, iou=1.0)
    found = exported.detect(image)
    theirs = transformers.RTDetrImageProcessor().post_process_object_detection(
        outputs, threshold=0.0, target_sizes=[(SIDE, SIDE)])[0]
    assert exported.class_names == NAMES
    assert found.class_ids == tuple(NAMES[int(number)] for number in theirs['labels'])
    px = np.abs(found.bboxes_xyxy - np.clip(theirs['boxes'].numpy(), 0, SIDE)).max()
    score = np.abs(found.scores - theirs['scores'].numpy()).max()
    print(f'\nboxes at most {px:.5f} px apart, scores {score:.6f}')
    assert px < 0.5 and score < 0.01


WATCHED_RUN = """
import json, os, sys
events = []
def watch(event, arguments):
    if event in ('socket.connect', 'socket.getaddrinfo', 'socket.gethostbyname', 'os.system',
                 'socket.sendto') or event == 'subprocess.Popen' and 'pip' in str(arguments):
        events.append(f'{event} {arguments}')
sys.addaudithook(watch)

import numpy as np
from cliploc_ros.models.onnx_detector import load_detector
from cliploc_ros.models.protocols import DetectorOptions
detector = load_detector(DetectorOptions(sys.argv[1], cache_dir=sys.argv[2]))
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


NOISE_RGB = np.random.default_rng(0).integers(0, 255, (240, 320, 3), dtype=np.uint8)
THREE = protocols.prompts_of_names('mug, office chair, potted plant')


@pytest.fixture(scope='session')
def folder(tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp('open_vocabulary')
    open_weights.write_open_yolo(path / 'world.pt', 'yolov8n-worldv2.yaml')
    open_weights.write_open_yolo(path / 'yoloe.pt', 'yoloe-v8n-seg.yaml', 'segment')
    open_weights.write_tower(path / 'tower.ts')
    return path


def options_of(folder, model='world.pt', prompts=THREE, **changes) -> protocols.DetectorOptions:
    return protocols.DetectorOptions(**{
        'model': str(folder / model), 'conf': 0.0, 'imgsz': 320, 'prompts': prompts,
        'cache_dir': str(folder / 'cache'), 'text_model': str(folder / 'tower.ts'), **changes})


@pytest.mark.parametrize('name', ['world.pt', 'yoloe.pt'])
def test_it_detects_the_texts_as_ultralytics_does(folder, name):
    exported = load_detector(options_of(folder, name, iou=1.0))
    model = load_yolo(folder / name)
    texts = [text for text, _ in THREE]
    assert exported.class_names == tuple(texts)
    with torch.no_grad():
        rows = open_weights.TextTower(512)(open_clip.get_tokenizer('ViT-B-32')(texts))
        rows = torch.nn.functional.normalize(rows, dim=-1)[None]
        if name == 'yoloe.pt':
            model.set_classes(texts, model.model.model[-1].get_tpe(rows))
        else:
            model.model.get_text_pe = lambda *_, **__: rows  # its own tower is another package
            model.set_classes(texts)
    found = exported.detect(NOISE_RGB)
    rows, classes = by_ultralytics(model, NOISE_RGB, conf=0.0, imgsz=320, iou=1.0)
    # random weights give nearly equal scores: rounding decides the order, and which box is dropped
    equal = (np.abs(found.bboxes_xyxy[:50, None] - rows[:, :4]).max(axis=2) < 0.5) & (
        np.array(found.class_ids[:50])[:, None] == classes) & (
        np.abs(found.scores[:50, None] - rows[:, 4]) < 1e-3)
    print(f'\n{equal.any(axis=1).mean():.2f} of the boxes are equal')
    assert equal.any(axis=1).mean() > 0.7


def test_two_texts_of_a_class_find_an_object_once(folder):
    apart = load_detector(options_of(folder, prompts=(('mug', 'mug'), ('red', 'red'))))
    joined = load_detector(options_of(folder, prompts=(('mug', 'mug'), ('red', 'mug'))))
    assert joined.class_names == ('mug',)
    both, once = apart.detect(NOISE_RGB), joined.detect(NOISE_RGB)
    assert set(both.class_ids) == {'mug', 'red'} and set(once.class_ids) == {'mug'}
    overlaps = ops.box_iou(*(torch.from_numpy(one.bboxes_xyxy) for one in (both, once))).numpy()
    assert (overlaps.max(axis=1) > 0.7).all(), 'each is represented'
    among = ops.box_iou(*[torch.from_numpy(once.bboxes_xyxy)] * 2).fill_diagonal_(0.0)
    assert among.max() <= 0.7 and (np.diff(once.scores) <= 0.0).all()


def test_a_vocabulary_needs_a_network_that_takes_texts_and_its_tower(weights, folder, cache):
    with pytest.raises(OptionsError, match='takes no texts'):
        detector(weights, cache, prompts=THREE)
    with pytest.raises(ModelError, match='is not a text tower'):
        load_detector(options_of(folder, text_model=str(weights), model='yoloe.pt'))


def test_the_texts_of_a_map():
    room = replace(make_room(), labels=(*['red mug'] * 4, *['white mug'] * 7, 'a'))
    prompts = protocols.prompts_of_map(room, 'map.yaml')
    assert prompts[:3] == (('a', 'a'), ('b', 'b'), ('c', 'c'))
    # two of four red mugs are of class a; 'a' is a class, and no other text
    assert prompts[3] == ('red mug', 'a') and prompts[4][0] == 'white mug' and len(prompts) == 5


def test_recordings_depend_on_the_vocabulary(folder):
    frames = Frames(folder, 1, lambda wanted: iter(()))
    described = [describe(frames, RecordingOptions(options, None, EVERY_FRAME)) for options in (
        options_of(folder), options_of(folder, prompts=THREE[:2]),
        options_of(folder, text_model=''), options_of(folder, prompts=(), text_model=''))]
    assert len(set(described)) == 4


def test_profiles_name_published_networks():
    import_ultralytics()
    from ultralytics.utils.downloads import GITHUB_ASSETS_NAMES

    unnamed = protocols.ClipOptions(model='', pretrained='')
    for name, profile in protocols.PROFILES.items():
        assert profile.detector in GITHUB_ASSETS_NAMES or is_hub_name(profile.detector)
        # an entry of the model hub can be stored for a start without a network
        assert is_hub_name(profile.clip_pretrained) or open_clip.get_pretrained_cfg(
            profile.clip_model, profile.clip_pretrained)['hf_hub']
        assert protocols.with_encoder(unnamed, name).pretrained == profile.clip_pretrained
        unset = protocols.DetectorOptions('')
        assert protocols.with_detector(unset, name).model == profile.detector
    with pytest.raises(OptionsError, match="profile 'auto' is not one of accurate, balanced"):
        protocols.with_encoder(unnamed, 'auto')


@pytest.mark.parametrize(('model', 'pretrained', 'path', 'named'), [
    ('RN50', '', '', ('RN50', 'openai')),
    ('', 'weights.pt', '', ('ViT-L-14', 'weights.pt')),
    ('', '', 'weights.pt', ('ViT-L-14', 'openai')),
    ('RN50', 'cc12m', '', ('RN50', 'cc12m'))])
def test_names_override_a_profile(model, pretrained, path, named):
    encoder = protocols.with_encoder(protocols.ClipOptions(model, pretrained, path), 'fast')
    assert (encoder.model, encoder.pretrained) == named
    assert encoder.checkpoint_path == path


# ---- weights localize the demo, also without PyTorch once they are exported
ONNX = (ASSETS / 'yolo.onnx', '', ASSETS / 'clip')
WEIGHTS = (ASSETS / 'yolo.pt', ASSETS / 'clip.json', ASSETS / 'clip.safetensors')


def localizing(networks, out):
    """Return the arguments of evaluate for some images of the demo."""
    model, clip_model, pretrained = networks
    named = ['--clip-model', clip_model] if clip_model else []
    return ['--tum', ASSETS / 'sequence', '--map', ASSETS / 'map.yaml', '--every', '10',
            '--methods', 'auto', '--trials', '1', '--sweep', '--no-figures', '--workers', '1',
            '--model', model, *named, '--clip-pretrained', pretrained, '--out', out]


@pytest.fixture
def localize_hidden(tmp_path):
    """Run evaluate in a process without PyTorch, and without the outputs of earlier runs."""
    return lambda *given: subprocess.run(
        [sys.executable, '-m', 'cliploc_ros.cli.evaluate', *localizing(*given)],
        env=hide_pytorch(tmp_path) | {'XDG_CACHE_HOME': str(tmp_path / 'cache'),
                                      'CLIPLOC_RECORDINGS': str(tmp_path)},
        capture_output=True, text=True, timeout=300, check=False)


@pytest.mark.parametrize(('networks', 'named'), [
    (WEIGHTS, '--no-clip'), ((WEIGHTS[0], *ONNX[1:]), 'yolo.pt')])
def test_without_pytorch_weights_are_refused_with_what_to_do(networks, named, localize_hidden,
                                                             tmp_path):
    done = localize_hidden(networks, tmp_path / 'out')
    assert done.returncode == 1 and 'Traceback' not in done.stderr
    assert 'is not installed' in done.stderr and 'export_network' in done.stderr
    assert 'script/setup models' in done.stderr and named in done.stderr


def test_weights_are_exported_once_and_then_need_no_pytorch(localize_hidden, tmp_path, run_here,
                                                            monkeypatch):
    monkeypatch.setenv('XDG_CACHE_HOME', str(tmp_path / 'cache'))
    found, here = [], lambda *given: run_here(evaluate.main, *localizing(*given))
    for networks, run in ((ONNX, here), (WEIGHTS, here), (WEIGHTS, localize_hidden)):
        done = run(networks, tmp_path / 'out')
        assert done.returncode == 0, done.stderr
        found.append([(row['accepted'], row['error_m'])
                      for row in json.loads((tmp_path / 'out/results.json').read_text())])
    onnx, exported, again = found
    assert exported == again
    assert [accepted for accepted, _ in onnx] == [accepted for accepted, _ in exported]
    off = [abs(one - other) for (accepted, one), (_, other) in zip(onnx, exported, strict=True)
           if accepted]
    print(f'\n{len(off)} of {len(onnx)} poses accepted, errors differ by {1e3 * max(off):.2f} mm')
    assert len(off) >= len(onnx) // 2 and max(off) < 0.01
