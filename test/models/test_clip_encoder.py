# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""CLIP's embeddings equal open_clip's own, from every form of checkpoint."""

import warnings

import numpy as np
import open_clip
import pytest
import torch
from open_clip.model import convert_to_custom_text_state_dict
from safetensors.torch import save_file

from cliploc_ros.models.clip_encoder import ClipEncoder, load_encoder
from cliploc_ros.models.clip_towers import read_state_dict
from cliploc_ros.models.clip_weights import ClipOptions, resolve_clip_weights
from cliploc_ros.models.images import crop_bounds

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
    # Weights in this format were trained with OpenAI's activation.
    reference = with_quick_gelu(small_clip)
    bounds = crop_bounds(BBOXES, 640, 480)
    crops = reference.crops(image_rgb, bounds)
    assert difference(encoder.encode_crops(image_rgb, BBOXES), crops) < 1e-5
    assert difference(label_embeddings, reference.labels(LABELS)) < 1e-5
    assert difference(crops, small_clip.crops(image_rgb, bounds)) > 1e-4
