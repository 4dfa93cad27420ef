# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""The export of a CLIP of open_clip gives its embeddings, and refuses files that are no CLIP."""

import json
import logging
import os
import warnings
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
from PIL import Image
from without_pytorch import Lazy

from cliploc_ros.cli.export_network import main as export_network
from cliploc_ros.errors import ModelError
from cliploc_ros.models.clip_encoder import ClipEncoder, encode_labels
from cliploc_ros.models.observer import crop_bounds
from cliploc_ros.models.onnx_clip import OnnxTextTower, resolve_clip_weights
from cliploc_ros.models.onnx_detector import load_detector
from cliploc_ros.models.protocols import ClipOptions, DetectorOptions
from demo import ASSETS

pytestmark = pytest.mark.full
open_clip, safetensors, torch = map(Lazy, ('open_clip', 'safetensors.torch', 'torch'))

LABELS = ['a red mug', 'Dining-table, 2.5m wide!!', "the dog's bowls, don't", 'Büro', 'very ' * 90]
BBOXES = np.array([[100.0, 50, 300, 250], [0, 0, 640, 480], [-40, -30, 90.5, 60.2],
                   [600.1, 10, 900, 470.9], [300, 200, 301, 201], [320, 0, 335, 200]])
# CLIP's architecture at a small size.
SMALL = {
    'embed_dim': 64,
    'vision_cfg': {'image_size': 224, 'layers': 2, 'width': 64, 'head_width': 32,
                   'patch_size': 32},
    'text_cfg': {'context_length': 77, 'vocab_size': 49408, 'width': 64, 'heads': 2, 'layers': 2}}


class Reference(NamedTuple):
    """The model that open_clip loads from a checkpoint."""

    config: Path
    file: Path
    model: Any
    preprocess: Any

    def embed(self, image_rgb: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the embeddings of the crops at BBOXES, and of LABELS."""
        images = [Image.fromarray(np.ascontiguousarray(image_rgb[top:bottom, left:right]))
                  for left, top, right, bottom in crop_bounds(BBOXES, 640, 480)]
        with torch.inference_mode():
            batch = torch.stack([self.preprocess(image) for image in images])
            tokens = open_clip.get_tokenizer(self.config.stem)(LABELS)
            return (self.model.encode_image(batch, normalize=True).numpy(),
                    self.model.encode_text(tokens, normalize=True).numpy())


def reference(config: Path, file: Path, **changes: object) -> Reference:
    model, _, preprocess = open_clip.create_model_and_transforms(
        config.stem, pretrained=str(file), **changes)
    return Reference(config, file, model.eval(), preprocess)


@pytest.fixture(scope='module')
def small_clip(tmp_path_factory) -> Reference:
    folder = tmp_path_factory.mktemp('small_clip')
    config, file = folder / 'small-clip.json', folder / 'weights.pt'
    config.write_text(json.dumps(SMALL))
    open_clip.add_model_config(config)
    torch.manual_seed(0)
    torch.save(open_clip.create_model(config.stem).state_dict(), file)
    return reference(config, file)


@pytest.fixture(scope='module')
def image_rgb() -> np.ndarray:
    """Return an image with structure at all scales, 640 x 480."""
    y, x = np.mgrid[0:480, 0:640]
    waves = np.stack([np.sin(x / 37) + np.cos(y / 23), np.sin((x + y) / 11), np.cos(x * y / 9e3)],
                     axis=-1)
    noise = np.random.default_rng(1).normal(0, 8, waves.shape)
    return (127 + 50 * waves + noise).clip(0, 255).astype(np.uint8)


def options_of(clip: Reference | Path, cache: Path, file: Path | None = None) -> ClipOptions:
    return (ClipOptions(pretrained=str(clip), cache_dir=str(cache)) if isinstance(clip, Path)
            else ClipOptions(str(clip.config), str(file or clip.file), cache_dir=str(cache)))


def load(*clip: Any) -> ClipEncoder:
    options = options_of(*clip)
    return ClipEncoder(resolve_clip_weights(options), options)


def least_cosines(options: ClipOptions, expected: Reference, image_rgb: np.ndarray) -> list[float]:
    weights = resolve_clip_weights(options)
    found = (ClipEncoder(weights, options).encode_crops(image_rgb, BBOXES),
             encode_labels(weights, LABELS, options))
    assert all(rows.dtype == np.float32 for rows in found)
    return [float((rows * wanted).sum(axis=1).min())
            for rows, wanted in zip(found, expected.embed(image_rgb), strict=True)]


def write_torchscript(model, file):
    root = torch.nn.Module()
    for name, tensor in model.state_dict().items():
        *path, leaf = name.split('.')
        module = root
        for part in path:
            if not hasattr(module, part):
                module.add_module(part, torch.nn.Module())
            module = getattr(module, part)
        module.register_buffer(leaf, tensor)
    with warnings.catch_warnings():
        warnings.simplefilter('ignore')
        torch.jit.script(root).save(file)


@pytest.mark.parametrize(('write', 'suffix'), [
    (lambda model, file: torch.save({'epoch': 3, 'state_dict': {
        f'module.{name}': tensor for name, tensor in model.state_dict().items()}}, file), '.pt'),
    (lambda model, file: safetensors.save_file({
        name: tensor.contiguous() for name, tensor in model.state_dict().items()}, file),
     '.safetensors'),
    (write_torchscript, '.ts')], ids=['training', 'safetensors', 'openai'])
def test_forms_of_checkpoints(small_clip, tmp_path, image_rgb, write, suffix):
    file, expected = tmp_path / f'weights{suffix}', small_clip
    write(small_clip.model, file)
    if suffix == '.ts':  # weights in OpenAI's format were trained with its activation function
        expected = reference(small_clip.config, small_clip.file, force_quick_gelu=True)
        other = (expected.embed(image_rgb)[0] * small_clip.embed(image_rgb)[0]).sum(axis=1)
        assert other.min() < 0.99999, 'the two activations differ'
    encoder = load(small_clip, tmp_path, file)
    cosines = least_cosines(options_of(small_clip, tmp_path, file), expected, image_rgb)
    print(f'\nleast cosine to open_clip: {cosines}')
    assert cosines[0] > 0.9999 and cosines[1] > 0.999999  # crops may be encoded in bf16
    # the batch size has no influence
    assert encoder.encode_crops(image_rgb, BBOXES[:1])[0] @ encoder.encode_crops(
        image_rgb, BBOXES)[0] > 0.9999
    assert encoder.encode_crops(image_rgb, BBOXES[:0]).shape == (0, encoder.embed_dim)


@pytest.fixture(scope='module')
def exported(small_clip, tmp_path_factory) -> Path:
    """Return a CLIP as export_network writes it."""
    folder = tmp_path_factory.mktemp('export') / 'clip'
    assert export_network(['--clip-model', str(small_clip.config), '--clip-pretrained',
                           str(small_clip.file), '--half', '--out', str(folder)]) == 0
    return folder


def test_export_network_gives_the_embeddings_of_open_clip(exported, small_clip, tmp_path,
                                                          image_rgb, caplog):
    assert exported.stat().st_mode & 0o055 == 0o055, 'other users may read it'
    encoder = load(exported, tmp_path)
    assert min(least_cosines(options_of(exported, tmp_path), small_clip, image_rgb)) > 0.999
    # embeddings that were made with the weights themselves stay valid
    assert encoder.key == load(small_clip, tmp_path).key
    caplog.clear()
    with caplog.at_level(logging.INFO):
        load(small_clip, tmp_path)
    assert caplog.text == '', 'the second start exports nothing'


def test_tokens_equal_those_of_open_clip(exported, tmp_path):
    rng = np.random.default_rng(0)
    letters = [*"abcdefghijklmnopqrstuvwxyz ABC 0123 '-_.,!?&;<>\"’“äöüßéñ",
               *'椅子ﬁﬂＷ½\u0301🙂\u00a0\t']
    texts = [''.join(rng.choice(letters, rng.integers(0, 30))) for _ in range(10_000)]
    texts += [*LABELS, 'cafe\u0301', '½ pint ²', '', '&amp; &lt;b&gt;', '‘quoted’ “x”', 'aaaaaaa',
              'ﬁne ﬂoor', 'Ｗｉｄｅ', "''s", 'İstanbul', '<start_of_text> x']
    weights = resolve_clip_weights(ClipOptions(pretrained=str(exported)))
    found, _ = OnnxTextTower(weights, str(tmp_path)).tokens(texts)
    assert np.array_equal(found, open_clip.get_tokenizer('ViT-B-32')(texts).numpy())


@pytest.mark.parametrize('damage', [
    lambda folder: os.truncate(folder / 'visual/model.onnx', 1000),
    lambda folder: (folder / 'export.json').write_text('{}')])
def test_a_damaged_export_is_made_again(small_clip, tmp_path, image_rgb, caplog, damage):
    before = load(small_clip, tmp_path).encode_crops(image_rgb, BBOXES)
    folder, = (tmp_path / 'onnx').iterdir()
    damage(folder)
    caplog.clear()
    assert np.array_equal(load(small_clip, tmp_path).encode_crops(image_rgb, BBOXES), before)
    *_, warning = (record for record in caplog.records if record.levelno >= logging.WARNING)
    assert f'{folder} is damaged' in warning.getMessage()
    assert [*(tmp_path / 'onnx').iterdir()] == [folder]


def refusal(model: object, file: object, cache: Path) -> str:
    with pytest.raises(ModelError) as caught:
        resolve_clip_weights(ClipOptions(str(model), str(file), cache_dir=str(cache)))
    message = str(caught.value)
    assert '\n' not in message and len(message) < 1000
    assert not (cache / 'onnx').exists()
    return message


def test_an_export_that_gives_other_results_is_refused(small_clip, tmp_path):
    torch.save({name: torch.full_like(tensor, float('nan')) for name, tensor in
                small_clip.model.state_dict().items()}, tmp_path / 'weights.pt')
    assert 'relative error of nan' in refusal(small_clip.config, tmp_path / 'weights.pt', tmp_path)


@pytest.mark.parametrize(('content', 'message'), [
    (b'', 'holds no weights'), (b'PK\x03\x04' + bytes(1000), 'truncated'),
    (b'\x80\x02garbage', 'not a checkpoint')])
def test_files_that_are_no_weights(small_clip, tmp_path, content, message):
    file = tmp_path / 'weights.pt'
    file.write_bytes(content)
    text = refusal(small_clip.config, file, tmp_path)
    assert message in text and str(file) in text


def test_other_clips(small_clip, tmp_path):
    (tmp_path / 'own.json').write_text('{"embed_dim": 3}')
    for model, file, *parts in (
            ('RN50', small_clip.file, str(small_clip.file), "of CLIP model 'RN50'"),
            ('ViT-B32', small_clip.file, "unknown CLIP model 'ViT-B32'", 'ViT-B-32'),
            ('ViT-B-32', 'opnai', "unknown weights 'opnai'", 'openai'),
            ('ViT-B-32', tmp_path / 'gone.pt', 'gone.pt does not exist'),
            (tmp_path / 'own.json', small_clip.file, 'own.json', 'lacks vision_cfg, text_cfg'),
            (tmp_path / 'gone.json', small_clip.file, 'gone.json is missing')):
        text = refusal(model, file, tmp_path)
        assert all(part in text for part in parts), text


class Hostile:
    """Runs a command when it is unpickled."""

    def __init__(self, proof: Path) -> None:
        self.proof = proof

    def __reduce__(self):
        return os.system, (f'touch {self.proof}',)


@pytest.mark.parametrize('zipped', [True, False])
def test_pickled_code_is_never_run(small_clip, tmp_path, zipped):
    file, proof = tmp_path / 'weights.pt', tmp_path / 'proof'
    torch.save({'visual.proj': Hostile(proof)}, file, _use_new_zipfile_serialization=zipped)
    assert 'not a checkpoint' in refusal(small_clip.config, file, tmp_path)
    with pytest.raises(ModelError, match='not a detection'):
        load_detector(DetectorOptions(str(file), cache_dir=str(tmp_path)))
    assert not proof.exists()


def test_a_network_is_exported_to_a_new_place_only(exported, tmp_path, capsys):
    for arguments, named in ((['--clip-model', 'x'], 'exists'), ([], 'name either a detector'),
                             (['--model', 'x.pt'], 'exists'),
                             (['--clip-model', 'x', '--model', 'y'], 'name either')):
        assert export_network([*arguments, '--out', str(exported)]) == 1
        assert named in capsys.readouterr().err
    assert export_network(['--clip-pretrained', str(exported), '--out', str(tmp_path / 'x')]) == 1
    assert 'has ONNX files already' in capsys.readouterr().err
    assert export_network(['--model', str(ASSETS / 'yolo.pt'), '--out', 'yolo.pt']) == 1
    file = tmp_path / 'own.onnx'
    assert export_network(['--model', str(ASSETS / 'yolo.pt'), '--out', str(file)]) == 0
    assert f'{file}: ' in capsys.readouterr().out and file.stat().st_size > 4e6
