# SPDX-FileCopyrightText: 2026 the cliploc_ros authors
# SPDX-License-Identifier: Apache-2.0
"""Phrases of a vocabulary are encoded once, class by class, with the demo's CLIP."""

import logging
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from cliploc_ros.models.clip_encoder import encode_labels
from cliploc_ros.models.clip_weights import ClipOptions, resolve_clip_weights
from cliploc_ros.models.phrase_embeddings import embed_phrases

ASSETS = Path(__file__).resolve().parents[2] / 'cliploc_ros/demo/assets'
PHRASES = {'mug': ('a red mug', 'a blue mug with white dots'), 'box': ('a box',)}


@pytest.fixture
def clip(tmp_path):
    return ClipOptions(model=str(ASSETS / 'clip.json'), device='cpu', cache_dir=str(tmp_path),
                       pretrained=str(ASSETS / 'clip.safetensors'))


def test_each_class_is_encoded_once(clip, caplog):
    weights = resolve_clip_weights(clip)
    found = embed_phrases(weights, clip, PHRASES)
    assert list(found) == list(PHRASES)
    for name, texts in PHRASES.items():
        alone = encode_labels(weights, texts, torch.device('cpu'))
        np.testing.assert_allclose(found[name], alone, atol=1e-6)
    assert 'CLIP reads 3 phrases of 2 classes' in caplog.text
    caplog.clear()
    more = embed_phrases(weights, clip, PHRASES | {'can': ('a can', 'a tin')})
    assert 'CLIP reads 2 phrases of 1 classes' in caplog.text
    caplog.clear()
    again = embed_phrases(weights, clip, {'can': ('a can', 'a tin'), 'mug': PHRASES['mug']})
    assert caplog.text == ''
    assert list(again) == ['can', 'mug']
    np.testing.assert_array_equal(again['can'], more['can'])
    np.testing.assert_array_equal(again['mug'], found['mug'])
    assert embed_phrases(weights, clip, {}) == {}


def test_without_a_place_for_the_cache_phrases_are_encoded_all_the_same(clip, tmp_path, caplog):
    file = tmp_path / 'file'
    file.write_text('')
    nowhere = replace(clip, cache_dir=str(file / 'cache'))
    with caplog.at_level(logging.WARNING):
        found = embed_phrases(resolve_clip_weights(nowhere), nowhere, PHRASES)
    assert found['mug'].shape == (2, 128)
    assert 'are not cached' in caplog.text
