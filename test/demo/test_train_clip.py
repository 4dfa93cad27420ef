# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Train the demo's CLIP: its loss decreases, and its file loads like any CLIP."""


import numpy as np
import pytest
import torch

from cliploc_ros.models.clip_encoder import ClipEncoder, encode_labels
from cliploc_ros.models.onnx_clip import resolve_clip_weights
from cliploc_ros.models.protocols import ClipOptions
from demo.world import train_clip

pytestmark = pytest.mark.full


def test_it_learns_and_is_saved_as_any_clip(worlds, tmp_path, capsys):
    model, tokenizer, preprocess = train_clip.make_model(train_clip.CONFIG, seed=0)
    objects = list(train_clip.read_crops(worlds / 'world_000').values())
    assert len(objects) > 10
    losses = train_clip.train(objects, model, tokenizer, preprocess, steps=12, batch=16, seed=0)
    assert np.mean(losses[-3:]) < np.mean(losses[:3]) - 0.1
    file = tmp_path / 'clip.safetensors'
    train_clip.save(model, file)
    labels = ('a red mug', 'a blue box with white dots')
    clip = ClipOptions(model=str(train_clip.CONFIG), pretrained=str(file), cache_dir=str(tmp_path))
    weights = resolve_clip_weights(clip)
    encoder, embeddings = ClipEncoder(weights, clip), encode_labels(weights, labels, clip)
    model.eval()
    with torch.no_grad():
        wanted = model.encode_text(tokenizer(list(labels)), normalize=True).numpy()
    np.testing.assert_allclose(embeddings, wanted, atol=5e-3)  # half precision on disk
    crop = objects[0][0]
    image = np.asarray(crop.image)
    box = np.array([[0, 0, image.shape[1] - 1, image.shape[0] - 1]], dtype=float)
    assert encoder.encode_crops(image, box).shape == (1, 128)
