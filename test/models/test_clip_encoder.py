# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""CLIP's embeddings equal open_clip's; embeddings of maps; weights that cannot be used."""

import os
import warnings
from dataclasses import replace
from pathlib import Path

import numpy as np
import open_clip
import pytest
import torch
from open_clip.model import convert_to_custom_text_state_dict
from safetensors.torch import save_file
from scene import make_room

from cliploc_ros.core.map.joined_map import join_maps
from cliploc_ros.core.map.landmark_details import LandmarkDetails
from cliploc_ros.core.map.landmark_embeddings import (
    LandmarkEmbeddings,
    embeddings_path,
    save_landmark_embeddings,
)
from cliploc_ros.core.map.map_file import write_map
from cliploc_ros.errors import ModelError
from cliploc_ros.models.clip_encoder import ClipEncoder, load_encoder
from cliploc_ros.models.clip_towers import read_state_dict
from cliploc_ros.models.clip_weights import ClipOptions, resolve_clip_weights
from cliploc_ros.models.files import fingerprint_file
from cliploc_ros.models.images import crop_bounds
from cliploc_ros.models.map_rows import embed_map, load_encoder_for_map
from cliploc_ros.models.profiles import load_detector
from cliploc_ros.models.protocols import DetectorOptions

pytestmark = pytest.mark.full

LABELS = ['a red mug', 'keyboard', 'a red mug', 'a stack of books beside the monitor', '']
BBOXES = np.array([
    [100.0, 50, 300, 250], [0, 0, 640, 480], [-40, -30, 90.5, 60.2], [600.1, 10, 900, 470.9],
    [300, 200, 301, 201], [10.5, 400, 200, 410], [320, 0, 335, 200], [5, 5, 45, 480]])


def options(reference, tmp_path, **changes) -> ClipOptions:
    return ClipOptions(**{'model': reference.name, 'pretrained': str(reference.file),
                          'device': 'cpu', 'cache_dir': str(tmp_path), 'inference': 'pytorch',
                          **changes})


def load_image_encoder(clip_options: ClipOptions) -> ClipEncoder:
    return ClipEncoder(resolve_clip_weights(clip_options), clip_options)


def difference(first: np.ndarray, second: np.ndarray) -> float:
    return float(np.abs(np.asarray(first) - np.asarray(second)).max())


def test_embeddings_equal_those_of_open_clip(large_clip, tmp_path, image_rgb):
    encoder, label_embeddings = load_encoder(options(large_clip, tmp_path), LABELS)
    crops = encoder.encode_crops(image_rgb, BBOXES)
    assert crops.dtype == label_embeddings.unique.dtype == np.float32
    assert crops.shape == (len(BBOXES), encoder.embed_dim) == (8, 512)
    expected = large_clip.crops(image_rgb, crop_bounds(BBOXES, 640, 480))
    errors = {'crops': difference(crops, expected),
              'labels': difference(label_embeddings, large_clip.labels(LABELS)),
              'labels from the cache': difference(
                  load_encoder(options(large_clip, tmp_path), LABELS[::-1]).label_embeddings,
                  large_clip.labels(LABELS)[::-1])}
    print(f'\nlargest difference to open_clip: {errors}')
    assert max(errors.values()) < 1e-5
    assert np.allclose(np.linalg.norm(crops, axis=1), 1.0, atol=1e-6)


def write_training_checkpoint(model, file):
    state = {f'module.{name}': tensor for name, tensor in model.state_dict().items()}
    torch.save({'epoch': 3, 'name': 'run', 'state_dict': state}, file)


def write_old_pickle(model, file):
    torch.save(model.state_dict(), file, _use_new_zipfile_serialization=False)


def write_safetensors(model, file):
    save_file({name: tensor.contiguous() for name, tensor in model.state_dict().items()}, file)


def write_custom_text(model, file):
    torch.save(convert_to_custom_text_state_dict(model.state_dict()), file)


@pytest.mark.parametrize(('write', 'suffix'), [
    (write_training_checkpoint, '.pt'), (write_old_pickle, '.pt'),
    (write_safetensors, '.safetensors'), (write_custom_text, '.bin')])
def test_forms_of_checkpoints(small_clip, tmp_path, write, suffix):
    file = tmp_path / f'weights{suffix}'
    write(small_clip.model, file)
    expected, found = read_state_dict(small_clip.file), read_state_dict(file)
    assert found.keys() == expected.keys()
    assert all(torch.equal(found[name], tensor) for name, tensor in expected.items())
    encoder = load_image_encoder(options(small_clip, tmp_path, pretrained=str(file)))
    tower = encoder._tower.model.visual
    assert all(torch.equal(tensor, expected[f'visual.{name}'])
               for name, tensor in tower.state_dict().items())


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


def with_quick_gelu(reference):
    model, _, preprocess = open_clip.create_model_and_transforms(
        reference.name, pretrained=str(reference.file), force_quick_gelu=True)
    return type(reference)(reference.name, reference.file, model.eval(), preprocess,
                           reference.tokenizer)


def test_openai_torchscript_archive(small_clip, tmp_path, image_rgb):
    file = tmp_path / 'ViT.pt'
    write_torchscript(small_clip.model, file)
    encoder, label_embeddings = load_encoder(
        options(small_clip, tmp_path, pretrained=str(file)), LABELS)
    # Weights in this format were trained with OpenAI's activation function.
    reference = with_quick_gelu(small_clip)
    bounds = crop_bounds(BBOXES, 640, 480)
    crops = reference.crops(image_rgb, bounds)
    assert difference(encoder.encode_crops(image_rgb, BBOXES), crops) < 1e-5
    assert difference(label_embeddings, reference.labels(LABELS)) < 1e-5
    assert difference(crops, small_clip.crops(image_rgb, bounds)) > 1e-4


ROOM = make_room()


@pytest.fixture(scope='module')
def clip(small_clip, tmp_path_factory):
    return ClipOptions(model=small_clip.name, pretrained=str(small_clip.file), device='cpu',
                       cache_dir=str(tmp_path_factory.mktemp('cache')), inference='pytorch')


@pytest.fixture
def map_file(tmp_path):
    write_map(tmp_path / 'room.yaml', ROOM)
    return tmp_path / 'room.yaml'


def images_of(key, ids=ROOM.landmark_ids, size=64):
    means = np.random.default_rng(0).normal(size=(len(ids), size))
    means /= np.linalg.norm(means, axis=1, keepdims=True)
    return LandmarkEmbeddings(key, tuple(ids), means.astype(np.float16),
                              np.zeros((0, size), np.float16), np.zeros(len(ids) + 1, np.int64))


def test_labels_with_weights_are_mixed(clip, small_clip):
    described = replace(ROOM, details=(
        LandmarkDetails(labels=((ROOM.labels[0], 3.0), ('a red cup', 1.0))),
        *[LandmarkDetails()] * (len(ROOM) - 1)))
    rows = np.asarray(embed_map(clip, described, [], 'both'))
    plain = np.asarray(embed_map(clip, ROOM, [], 'both'))
    assert np.array_equal(rows[1:], plain[1:])
    expected = np.array([3.0, 1.0]) @ small_clip.labels([ROOM.labels[0], 'a red cup'])
    assert rows[0] == pytest.approx(expected / np.linalg.norm(expected), abs=1e-5)


@pytest.mark.parametrize('compare', ['image', 'both'])
def test_images_of_this_encoder_are_compared(clip, map_file, compare):
    images = images_of(resolve_clip_weights(clip).key)
    save_landmark_embeddings(embeddings_path(map_file), images)
    plain = np.asarray(embed_map(clip, ROOM, [str(map_file)], 'text'))
    rows = np.asarray(load_encoder_for_map(clip, ROOM, [str(map_file)], compare).label_embeddings)
    assert np.array_equal(plain, np.asarray(embed_map(clip, ROOM, [], compare)))
    similar = np.sum(rows * images.means, axis=1)
    assert (similar > np.sum(plain * images.means, axis=1) + 0.2).all()
    if compare == 'image':
        assert np.array_equal(rows, images.means)
    # rows follow the map's order; added landmarks use their label
    fewer = images_of(images.encoder_key).in_order(ROOM.landmark_ids[:0:-1])
    save_landmark_embeddings(embeddings_path(map_file), fewer)
    again = np.asarray(embed_map(clip, ROOM, [str(map_file)], compare))
    assert np.isfinite(again).all()
    assert np.argmax(again[1:] @ images.means[1:].T, axis=1).tolist() == list(range(len(ROOM) - 1))


def test_images_of_several_maps_are_compared_together_or_not_at_all(clip, tmp_path, caplog):
    """Each map keeps its rows; if one map has no images, all are compared by labels."""
    maps = [replace(ROOM, frame_id='hall'), replace(ROOM, frame_id='attic').select([2, 0, 1])]
    files = [str(tmp_path / f'{landmark_map.frame_id}.yaml') for landmark_map in maps]
    both = join_maps(maps, files)
    for one, file in zip(maps, files, strict=True):
        write_map(file, one)
        save_landmark_embeddings(embeddings_path(file), images_of(
            resolve_clip_weights(clip).key, one.landmark_ids))
    rows = embed_map(clip, both, files, 'image')
    expected = [images_of('', landmark_map.landmark_ids).means for landmark_map in maps]
    assert np.array_equal(np.asarray(rows), np.concatenate(expected))
    for part, own in zip(rows.parts, expected, strict=True):
        assert np.array_equal(np.asarray(part), own)
    embeddings_path(files[1]).unlink()
    plain = np.asarray(embed_map(clip, ROOM, [], 'text'))
    rows = embed_map(clip, both, files, 'image')
    assert np.array_equal(np.asarray(rows), plain[[*range(len(ROOM)), 2, 0, 1]])
    warning, = (record for record in caplog.records if record.levelname == 'WARNING')
    assert f'{files[1]} has no image embeddings' in warning.getMessage()


def options_of(model: str, file: object, tmp_path: Path, **changes) -> ClipOptions:
    return ClipOptions(model, str(file), device='cpu', cache_dir=str(tmp_path),
                       inference='pytorch', **changes)


def refusal(clip_options: ClipOptions) -> str:
    with pytest.raises(ModelError) as caught:
        load_encoder(clip_options, ['a label'])
    message = str(caught.value)
    assert '\n' not in message and len(message) < 1000
    return message


@pytest.mark.parametrize(('content', 'message'), [
    (b'', 'is empty'),
    (b'version https://git-lfs.github.com/spec/v1\noid sha256:12\nsize 3\n', 'git lfs pull'),
    (b'\n<!DOCTYPE html><html><body>Sign in</body></html>', 'is a web page'),
    (b'just text', 'holds no weights'), (b'PK\x03\x04' + bytes(1000), 'truncated'),
    (b'\x80\x02garbage', 'not a checkpoint')])
def test_files_that_are_no_weights(tmp_path, content, message):
    file = tmp_path / 'weights.pt'
    file.write_bytes(content)
    text = refusal(options_of('ViT-B-32', file, tmp_path))
    assert message in text and str(file) in text


def test_weights_of_another_clip(small_clip, tmp_path):
    text = refusal(options_of('ViT-B-32', small_clip.file, tmp_path))
    assert str(small_clip.file) in text and "'ViT-B-32'" in text
    assert 'has shape' in text and 'more)' in text
    text = refusal(options_of('RN50', small_clip.file, tmp_path))
    assert 'weights' in text


class Hostile:
    """Runs a command when it is unpickled."""

    def __init__(self, proof: Path) -> None:
        self.proof = proof

    def __reduce__(self):
        return os.system, (f'touch {self.proof}',)


@pytest.mark.parametrize('zipped', [True, False])
def test_pickled_code_is_never_run(tmp_path, zipped):
    file, proof = tmp_path / 'weights.pt', tmp_path / 'proof'
    torch.save({'visual.proj': Hostile(proof)}, file, _use_new_zipfile_serialization=zipped)
    assert 'not a checkpoint' in refusal(options_of('ViT-B-32', file, tmp_path))
    with pytest.raises(ModelError, match='not a detection'):
        load_detector(DetectorOptions(str(file), device='cpu'))
    assert not proof.exists()


def test_fingerprint(tmp_path):
    file = tmp_path / 'weights'
    file.write_bytes(np.random.default_rng(0).bytes(20_000_000))
    first = fingerprint_file(file)
    assert fingerprint_file(file) == first
    content = bytearray(file.read_bytes())
    for offset in (0, len(content) // 2, len(content) - 1):
        changed = content[:]
        # A retrained tensor is longer than the gap between two blocks.
        changed[offset:offset + 400_000] = bytes(len(changed[offset:offset + 400_000]))
        file.write_bytes(changed)
        assert fingerprint_file(file) != first, offset
    file.write_bytes(content[:-1])
    assert fingerprint_file(file) != first
    file.write_bytes(b'')
    fingerprint_file(file)
